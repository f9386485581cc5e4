"""Characters that control a terminal, or that are invisible."""

import pytest

from lare_rl.util.sanitize import first_invisible, is_name, one_line, sanitize

INVISIBLE = {
    "escape": "\x1b",
    "tag": "\U000e0041",
    "grapheme joiner": "\u034f",
    "variation selector": "\ufe0f",
    "private use": "\ue000",
    "direction of writing": "\u202e",
    "zero width": "\u200b",
    "end of paragraph": "\u2029",
    "surrogate": "\ud800",
}


@pytest.mark.parametrize("letter", INVISIBLE.values(), ids=INVISIBLE)
def test_invisible_characters(letter):
    assert first_invisible(f"ab{letter}c") == 2
    assert sanitize(f"a\nb{letter}c") == "a\nb?c"
    assert one_line(f" a\n\tb{letter}c ") in ("a b?c", "a b c")  # a character that ends a line becomes a space


@pytest.mark.parametrize("text", ["plain", "two\nlines\tand a tab", "größe, ε, 漢字, e\u0301", "✅ 😀 ─ →", ""])
def test_visible_texts(text):
    assert first_invisible(text) is None
    assert sanitize(text) == text


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("tests pass", True),
        ("x" * 80, True),
        ("x" * 81, False),
        ("", False),
        (" a", False),
        ("a\nb", False),
        (1, False),
    ],
)
def test_is_name(value, expected):
    assert is_name(value) is expected
