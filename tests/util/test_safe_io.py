"""Reading of untrusted files."""

from pathlib import Path

import pytest

from lare_rl.errors import LareError
from lare_rl.turns.files import read_rollout_file
from lare_rl.util.safe_io import MAX_DEPTH, read_json, read_text, read_toml


def read_toml_array(text):
    return read_toml(f"x = {text}")


@pytest.mark.parametrize("depth", [MAX_DEPTH + 1, 988, 50_000])
@pytest.mark.parametrize(
    ("start", "end", "read"), [("[", "]", read_json), ('{"a":', "}", read_json), ("[", "]", read_toml_array)]
)
def test_deep_nesting(start, end, read, depth):
    with pytest.raises(ValueError, match="nested more than 64 deep"):
        read(start * depth + '"x"' + end * depth)
    if depth == MAX_DEPTH + 1:
        read(start * MAX_DEPTH + '"x"' + end * MAX_DEPTH if read is not read_toml_array else "[" * 63 + "1" + "]" * 63)


@pytest.mark.parametrize(
    "text",
    [
        *("a." * 200_000 + "a = 1", f"[{'a . ' * 5000}a]", "x = {" + '"a".' * 5000 + "a = 1}", "'a'." * 64 + "a = 1"),
        r'"a\"b".' * 8000 + "a = 1",
    ],
    ids=["key", "table", "inline", "quotes", "escapes"],
)
def test_deep_toml_names(text):
    with pytest.raises(ValueError, match="nested more than 64 deep"):
        read_toml(text)


def test_toml_with_dots():
    assert read_toml("a" * 900_000 + " = 1\n" + "c." * 60 + "c = 1  # " + "c." * 70)["a" * 900_000] == 1
    for quote in ('"', "'", '"""', "'''"):
        assert read_toml(f"b = {quote}{'One. ' * 70}{quote}")["b"] == "One. " * 70


def test_read_json():
    assert read_json(b'{"a": [1, {"b": null}], "c": 1.5}') == {"a": [1, {"b": None}], "c": 1.5}
    assert read_json('{"a": "two\nlines"}', strict=False) == {"a": "two\nlines"}
    assert read_json("-" + "1" * 1000) == -int("1" * 1000)
    with pytest.raises(ValueError, match=r"1,001 digits \(at most 1,000"):
        read_json("1" * 1001)


def test_read_text(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"\xef\xbb\xbfone\r\ntwo\r")
    assert read_text(path) == "one\ntwo\n"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"x" * ((1 << 20) + 1), "larger than 1 MB"),
        (b"\xff", "0xff"),
        (None, "No such file"),
        ("directory", "not a file"),
    ],
)
def test_unreadable_text(tmp_path, content, words):
    path = tmp_path / "file"
    if content == "directory":
        path.mkdir()
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(LareError, match=words):
        read_text(path, 1 << 20)


@pytest.mark.parametrize("read", [read_text, read_rollout_file])
def test_path_with_a_null_character(read):
    with pytest.raises(LareError, match="null"):
        read(Path("a\0b"))
