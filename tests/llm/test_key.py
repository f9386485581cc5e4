"""The key of a model is removed from everything that is saved, in all its spellings."""

import json

import pytest

from helpers.scripted_model import ScriptedModel
from helpers.toy_envs import PHI
from lare_rl.latent.function import LatentFunction
from lare_rl.llm.key import redact_key
from lare_rl.llm.recorder import Recorder
from lare_rl.llm.recording import Exchange
from lare_rl.llm.reply import parse_reply

KEY = "sk-a+key/that.nobody"


@pytest.fixture(autouse=True)
def secret(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", KEY)


def escape(pattern: str) -> str:
    return "".join(pattern.format(ord(letter)) for letter in KEY)


SPELLINGS = {
    "literal": KEY,
    "JSON": escape("\\u{:04x}"),
    "JSON, capitals": escape("\\u{:04X}"),
    "JSON, first letter": "\\u0073" + KEY[1:],
    "JSON in JSON": escape("\\\\u{:04x}"),
    "escaped slash": KEY.replace("/", "\\/"),
    "Python": escape("\\x{:02x}"),
    "Python, long": escape("\\U{:08x}"),
    "Python, octal": escape("\\{:03o}"),
    "braces": escape("\\u{{{:x}}}"),
}


@pytest.mark.parametrize("text", SPELLINGS.values(), ids=SPELLINGS)
def test_redact_key(text):
    assert redact_key(f"before {text} after") == "before [key] after"


@pytest.mark.parametrize("text", ["sk-a+key/that.somebody", "\\" * 200_000, "u0073k-a+key/that.nobody"])
def test_redact_key_keeps_other_texts(text):
    assert redact_key(text) == text


def test_redact_key_keeps_a_short_key(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", "none")
    assert redact_key("none") == "none"


@pytest.mark.parametrize("spelling", ["literal", "JSON", "JSON in JSON"])
def test_files_of_a_design(tmp_path, spelling):
    source = json.dumps(PHI).replace("effort", "effort KEY")
    text = f'{{"Understand": "KEY", "Analyze": "KEY", "Functions": {source}}}'.replace("KEY", SPELLINGS[spelling])
    exchange = {"stage": "candidate", "messages": [{"role": "user", "content": "Write."}], "replies": [text]}
    recorder = Recorder(ScriptedModel(), "Chase", "factors", exchanges=[Exchange(**exchange)])
    recorder.save(tmp_path / "record.json")
    function = LatentFunction("Chase", "factors", parse_reply(text).functions, 2, (), (2, 1), "m", (exchange,))
    function.save(tmp_path / "phi.py")
    assert "effort [key]" in (tmp_path / "phi.py").read_text()
    for name in ("phi.py", "phi.json", "record.json"):
        content = (tmp_path / name).read_text()
        assert redact_key(content) == content
    for name in ("phi.json", "record.json"):
        assert KEY not in repr(json.loads((tmp_path / name).read_text()))
