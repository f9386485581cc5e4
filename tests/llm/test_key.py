"""The key of a model is in nothing that is kept, however it is spelled."""

import json

import pytest

from helpers.toys import PHI
from lare_rl.latent.function import LatentFunction
from lare_rl.llm.key import without_key
from lare_rl.llm.recording import Recorder
from lare_rl.llm.reply import parse

KEY = "sk-a+key/that.nobody"


@pytest.fixture(autouse=True)
def secret(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", KEY)


def spelled(pattern: str) -> str:
    return "".join(pattern.format(ord(letter)) for letter in KEY)


SPELLINGS = {
    "as it is": KEY,
    "JSON": spelled("\\u{:04x}"),
    "JSON, in capitals": spelled("\\u{:04X}"),
    "JSON, the first letter": "\\u0073" + KEY[1:],
    "JSON in JSON": spelled("\\\\u{:04x}"),
    "a slash that is escaped": KEY.replace("/", "\\/"),
    "Python": spelled("\\x{:02x}"),
    "Python, long": spelled("\\U{:08x}"),
    "Python, octal": spelled("\\{:03o}"),
    "braces": spelled("\\u{{{:x}}}"),
}


@pytest.mark.parametrize("text", SPELLINGS.values(), ids=SPELLINGS)
def test_the_key_is_found_however_it_is_spelled(text):
    assert without_key(f"before {text} after") == "before [key] after"


@pytest.mark.parametrize("text", ["sk-a+key/that.somebody", "\\" * 200_000, "u0073k-a+key/that.nobody"])
def test_nothing_else_is_taken_out(text):
    assert without_key(text) == text


def test_a_short_key_is_a_word(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", "none")
    assert without_key("none") == "none"


def reply(spelling: str) -> str:
    """What a server sends that knows the key, and spells it within the JSON of the reply."""
    source = json.dumps(PHI).replace("effort", "effort KEY")
    return f'{{"Understand": "KEY", "Analyze": "KEY", "Functions": {source}}}'.replace("KEY", spelling)


@pytest.mark.parametrize("spelling", ["as it is", "JSON", "JSON in JSON"])
def test_the_key_is_in_no_file_of_a_design(tmp_path, spelling):
    text = reply(SPELLINGS[spelling])
    read = parse(text)
    recorder = Recorder("Chase", "factors", path=tmp_path / "record.json")
    recorder.take("candidate", [{"role": "user", "content": "Write."}], text, "m")
    exchanges = tuple(exchange.model_dump() for exchange in recorder.exchanges)
    LatentFunction("Chase", "factors", read.functions, 2, (), (2, 1), "m", exchanges).save(tmp_path / "phi.py")
    assert "effort [key]" in (tmp_path / "phi.py").read_text()
    for name in ("phi.py", "phi.json", "record.json"):
        kept = (tmp_path / name).read_text()
        assert without_key(kept) == kept
        assert KEY not in kept
    for name in ("phi.json", "record.json"):
        assert KEY not in repr(json.loads((tmp_path / name).read_text()))


def test_a_function_that_is_saved_by_hand_has_no_key(tmp_path):
    LatentFunction("Chase", "factors", f"{PHI}# {KEY}", 2, (), (2, 1)).save(tmp_path / "phi.py")
    assert (tmp_path / "phi.py").read_text().endswith("# [key]\n")
    assert KEY not in (tmp_path / "phi.json").read_text()
