"""Reading what somebody else wrote: within bounds, and one line where it cannot be read."""

import json

import pytest

from lare_rl.errors import LareError, shortened
from lare_rl.util.safe_io import DEEPEST, read_json, read_text, read_toml

DEEP = "it is nested more than 64 deep"


@pytest.mark.parametrize("deep", [DEEPEST, 500, 988, 50_000])
@pytest.mark.parametrize(
    ("begin", "end", "read"), [("[", "]", read_json), ('{"a":', "}", read_json), ("[", "]", lambda text: read_toml(f"x = {text}"))]
)  # fmt: skip
def test_what_is_nested_too_deep_is_refused(begin, end, read, deep):
    with pytest.raises(ValueError, match=f"^{DEEP}$"):
        read(begin * deep + '"x"' + end * deep)


def test_dots_nest_tables_without_a_bracket():
    for dotted in (
        "a." * 200_000 + "a = 1",
        f"[{'a . ' * 5000}a]",
        "x = {" + '"a".' * 5000 + "a = 1}",
        "'a'." * 64 + "a = 1",
    ):
        with pytest.raises(ValueError, match=f"^{DEEP}$"):
            read_toml(dotted)
    assert read_toml("a" * 900_000 + " = 1\nb = 'One. Two. Three.'\n" + "c." * 60 + "c = 1")["b"] == "One. Two. Three."


def test_what_is_nested_less_is_read():
    deep = "[" * (DEEPEST - 1) + "]" * (DEEPEST - 1)
    assert read_json(deep) == json.loads(deep)
    assert read_json(b'{"a": [1, {"b": null}], "c": 1.5}') == {"a": [1, {"b": None}], "c": 1.5}
    assert read_json('{"a": "two\nlines"}', strict=False) == {"a": "two\nlines"}


def test_a_number_has_only_so_many_digits():
    assert read_json("1" * 1000) == int("1" * 1000)
    with pytest.raises(ValueError, match=r"^a number of 1001 digits$"):
        read_json("1" * 1001)


def test_a_text_is_read_as_far_as_it_may_go(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"\xef\xbb\xbfone\r\ntwo\r")
    assert read_text(path) == "one\ntwo\n"
    path.write_bytes(b"x" * ((1 << 20) + 1))
    with pytest.raises(LareError) as error:
        read_text(path, 1 << 20)
    assert str(error.value) == f"{path} is larger than 1 MB"
    path.write_bytes(b"\xff")
    with pytest.raises(LareError, match="cannot be read: 'utf-8' codec can't decode byte 0xff"):
        read_text(path)
    with pytest.raises(LareError, match="is not a file"):
        read_text(tmp_path)
    with pytest.raises(LareError, match="No such file or directory"):
        read_text(tmp_path / "nowhere")


def test_what_cannot_be_shown_is_said_to_be():
    deep: list = []
    for _ in range(5000):
        deep = [deep]
    assert shortened(deep) == "a list that cannot be shown"
