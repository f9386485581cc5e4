"""Recordings, and the model that answers from them."""

import json
import os

import pytest

from helpers.scripted_model import ScriptedModel
from lare_rl.errors import LareError
from lare_rl.llm.recorder import Recorder
from lare_rl.llm.recording import RecordedModel, read_recording, shipped_recordings

REQUEST = [{"role": "user", "content": "Write some."}]
EXCHANGE = {"stage": "candidate", "messages": REQUEST, "replies": ["one", "two"]}
RECORDING = {"task": "Chase", "kind": "factors", "draw": 3, "model": "A model", "recorded": "2026-01-31"}
RECORDING |= {"temperature": None, "exchanges": [EXCHANGE]}


def recorded_model(**changes) -> RecordedModel:
    return RecordedModel([read_recording(json.dumps(RECORDING | changes), "Chase.draw3.json")], "Chase")


def test_replies():
    """A repeated request has all replies. Other requests have none."""
    other, later = EXCHANGE | {"messages": [], "replies": ["else"]}, EXCHANGE | {"replies": ["three"]}
    model = recorded_model(exchanges=[EXCHANGE, other, later])
    assert [model.reply(REQUEST, sample) for sample in (0, 1, 2, 0)] == ["one", "two", "three", "one"]
    assert model.name == "A model, recorded 2026-01-31, draw 3"
    for messages, sample in (([REQUEST[0] | {"role": "system"}], 0), (REQUEST * 2, 0), ([], 1), (REQUEST, 3)):
        with pytest.raises(LareError, match=rf"'Chase' \(reply {sample + 1}\): .*its exact requests"):
            model.reply(messages, sample)


def test_only_the_line_of_an_error_may_differ():
    def request(line, words):
        return [{"role": "user", "content": f"It failed:\nE-COST line {line}: {words}\nCorrect it."}]

    model = recorded_model(exchanges=[EXCHANGE | {"messages": request(27, "too many")}])
    assert model.reply(request(35, "too many"), 0) == "one"
    with pytest.raises(LareError, match="no recorded reply"):
        model.reply(request(27, "too few"), 0)


@pytest.mark.parametrize(("kind", "draw", "draws"), [("factors", 5, "0, 1, 2, 3, 4"), ("reward", 1, "draws are 0")])
def test_unknown_draw(kind, draw, draws):
    with pytest.raises(LareError, match=rf"{kind} .*draw {draw}.*{draws}$"):
        shipped_recordings(kind, draw)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "not valid JSON"),
        ("[" * 100_000, "not valid JSON"),
        ('{"task": "\\ud800"}', "surrogate"),
        ("{}", "'exchanges'"),
        ({"Understand": "", "Analyze": "", "Functions": ""}, "lare-rl verify X.json"),
        (RECORDING | {"note": "mine"}, "'note'"),
        (RECORDING | {"kind": "poems"}, "kind = 'poems'"),
        (RECORDING | {"exchanges": [EXCHANGE | {"stage": "chat"}]}, r"exchanges\.0\.stage = 'chat'"),
        (RECORDING | {"exchanges": [EXCHANGE | {"replies": [None]}]}, r"exchanges\.0\.replies\.0 = None"),
    ],
)
def test_invalid_recording(text, words):
    with pytest.raises(LareError, match=rf"X\.json.*{words}"):
        read_recording(text if isinstance(text, str) else json.dumps(text), "X.json")


def test_only_the_recording_of_the_same_exchanges_is_continued(tmp_path):
    path = tmp_path / "talk.json"
    model = ScriptedModel(replies=["one", "two"])
    Recorder(model, "Chase", "factors", path).ask("candidate", REQUEST)
    first = path.read_text()
    exchanges = read_recording(first, "talk.json").exchanges
    Recorder(model, "Chase", "factors", path, [*exchanges]).ask("candidate", REQUEST)
    assert model.numbers == [0, 1]
    content = path.read_text()
    assert read_recording(content, "talk.json").exchanges[0].replies == ["one", "two"]
    for text in (content, first.replace("Chase", "Walk"), first.replace("factors", "reward"), "{}", "my notes"):
        path.write_text(text)
        with pytest.raises(LareError, match="exists"):
            Recorder(model, "Chase", "factors", path, exchanges)


def test_failed_write_loses_no_reply(tmp_path, monkeypatch):
    path = tmp_path / "talk.json"
    recorder = Recorder(ScriptedModel(replies=["one", "two", "three"]), "Chase", "factors", path)

    def fail_to_ask():
        def fail(*_):
            raise OSError(28, "No space left on device")

        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", fail)
            with pytest.raises(LareError, match="No space left"):
                recorder.ask("candidate", REQUEST)

    fail_to_ask()
    assert list(tmp_path.iterdir()) == []
    recorder.ask("candidate", REQUEST)
    content = path.read_text()
    fail_to_ask()
    assert path.read_text() == content
    assert list(tmp_path.iterdir()) == [path]
    recorder.save(path, new=False)
    assert read_recording(path.read_text(), "talk.json").exchanges[0].replies == ["one", "two", "three"]
