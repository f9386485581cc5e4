"""Letters that steer a terminal or that nobody sees."""

import pytest

from lare_rl.util.sanitize import in_a_line, legible, unseen

HIDDEN = {
    "escape": "\x1b",
    "a tag": "\U000e0041",
    "soft hyphen": "\u00ad",
    "Mongolian vowel separator": "\u180e",
    "grapheme joiner": "\u034f",
    "Hangul filler": "\u3164",
    "variation selector": "\ufe0f",
    "empty Braille": "\u2800",
    "private use": "\ue000",
    "the direction of writing": "\u202e",
    "zero width": "\u200b",
    "a paragraph's end": "\u2029",
    "not assigned": "\u0378",
    "half a character": "\ud800",
    "C1": "\x9b",
}


@pytest.mark.parametrize("letter", HIDDEN.values(), ids=HIDDEN)
def test_what_nobody_sees_is_found_and_shown(letter):
    assert unseen(f"ab{letter}c") == 2
    assert legible(f"a\nb{letter}c") == "a\nb?c"
    assert in_a_line(f" a\n\tb{letter}c ") in ("a b?c", "a b c")  # where it ends a line, there is a space


@pytest.mark.parametrize("text", ["plain", "two\nlines\tand a tab", "größe, ε, 漢字, e\u0301", "✅ 😀 ─ →", ""])
def test_what_can_be_seen_is_left(text):
    assert unseen(text) is None
    assert legible(text) == text
