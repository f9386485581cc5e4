"""Recorded models: they answer what they know, and say plainly what they do not."""

import json
import os

import pytest

from helpers.toys import toy_spec
from lare_rl.envs.load import read_task
from lare_rl.errors import LareError
from lare_rl.llm.prompts import candidate, combine
from lare_rl.llm.recording import RecordedModel, Recorder, read_recording, shipped_recordings

KNOWN = [{"role": "user", "content": "Write some."}]
RECORDING = {
    "task": "Chase",
    "kind": "factors",
    "draw": 3,
    "model": "Somebody",
    "recorded": "2026-01-31",
    "temperature": None,
    "exchanges": [{"stage": "candidate", "messages": KNOWN, "replies": ["one", "two"]}],
}
EXCHANGE = RECORDING["exchanges"][0]


def recorded() -> RecordedModel:
    return RecordedModel([read_recording(json.dumps(RECORDING), "Chase.draw3.json")], "Chase")


def test_answers_what_it_knows_and_says_who_spoke():
    model = recorded()
    assert [model.reply(KNOWN, sample) for sample in (0, 1, 0)] == ["one", "two", "one"]
    assert model.name == "Somebody, recorded 2026-01-31, draw 3"


@pytest.mark.parametrize(
    ("messages", "sample"),
    [
        ([{"role": "user", "content": "Write some"}], 0),
        ([{"role": "system", "content": "Write some."}], 0),
        ([*KNOWN, *KNOWN], 0),
        ([], 0),
        (KNOWN, 2),
    ],
)
def test_refuses_what_was_not_recorded(messages, sample):
    with pytest.raises(LareError) as error:
        recorded().reply(messages, sample)
    said = str(error.value)
    assert said.startswith(f"no recorded reply fits this request for task 'Chase' (reply {sample + 1}): ")
    assert said.endswith("or by a method that needs none (--method bayes)")
    assert "\n" not in said


@pytest.mark.parametrize("draw", range(5))
def test_the_shipped_recordings_answer_the_shipped_tasks(draw):
    model = RecordedModel(shipped_recordings("factors", draw), "Reacher-v4")
    task = read_task("Reacher-v4")
    replies = [model.reply(candidate(task), sample) for sample in range(5)]
    assert len(set(replies)) == 5
    assert model.reply(combine(task, replies), 0)
    assert model.name.endswith(f", draw {draw}")


@pytest.mark.parametrize("key", ["description", "observation", "action"])
def test_one_changed_word_is_another_request(key):
    task = read_task("Reacher-v4")
    changed = toy_spec(**(task.model_dump() | {key: getattr(task, key) + " Please."}))
    model = RecordedModel(shipped_recordings("factors", 0), task.name)
    assert model.reply(candidate(task), 0)
    with pytest.raises(LareError, match="no recorded reply fits this request for task 'Reacher-v4'"):
        model.reply(candidate(changed), 0)


@pytest.mark.parametrize(
    ("kind", "draw", "message"),
    [
        ("factors", 5, "no recording of factors has draw 5; the draws are 0, 1, 2, 3, 4"),
        ("factors", -1, "no recording of factors has draw -1; the draws are 0, 1, 2, 3, 4"),
        ("reward", 1, "no recording of reward has draw 1; the draws are 0"),
    ],
)
def test_an_unknown_draw_is_refused(kind, draw, message):
    with pytest.raises(LareError) as error:
        shipped_recordings(kind, draw)
    assert str(error.value) == message


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "recording X.json is not JSON: Expecting value: line 1 column 1 (char 0)"),
        ('{"task": ', "recording X.json is not JSON: Expecting value: line 1 column 10 (char 9)"),
        (
            "{}",
            "recording X.json: the keys 'task', 'kind', 'draw', 'model', 'recorded', 'temperature', 'exchanges' are missing",
        ),
        (
            {"Understand": "", "Analyze": "", "Functions": ""},
            "X.json is a single reply, not a recording of requests and their replies: lare-rl verify X.json --task TASK reads the "
            "function in it",
        ),
        (RECORDING | {"note": "mine"}, "recording X.json: there is no key 'note'"),
        (RECORDING | {"kind": "poems"}, "recording X.json: kind = 'poems': input should be 'factors' or 'reward'"),
        (RECORDING | {"exchanges": 3}, "recording X.json: exchanges = 3: input should be a valid list"),
        (
            RECORDING | {"exchanges": [EXCHANGE | {"stage": "chat"}]},
            "recording X.json: exchanges.0.stage = 'chat': input should be 'candidate', 'combine', 'correct' or 'reflect'",
        ),
        (
            RECORDING | {"exchanges": [EXCHANGE | {"replies": [None]}]},
            "recording X.json: exchanges.0.replies.0 = None: input should be a valid string",
        ),
    ],
)
def test_a_broken_recording_is_refused(text, message):
    with pytest.raises(LareError) as error:
        read_recording(text if isinstance(text, str) else json.dumps(text), "X.json")
    assert str(error.value) == message


def test_a_recording_nested_without_end():
    with pytest.raises(LareError, match=r"recording X\.json is not JSON"):
        read_recording("[" * 100_000, "X.json")


def test_what_is_kept_outlives_a_write_that_fails(tmp_path, monkeypatch):
    path = tmp_path / "talk.json"
    recorder = Recorder("Chase", "factors", path=path)
    recorder.take("candidate", KNOWN, "one", "Somebody")
    before = path.read_text()

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "replace", full)
        with pytest.raises(LareError) as error:
            recorder.take("candidate", KNOWN, "two", "Somebody")
    assert str(error.value) == f"{path} cannot be written: No space left on device"
    assert path.read_text() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["talk.json"]
    recorder.keep("Somebody")
    assert read_recording(path.read_text(), "talk.json").exchanges[0].replies == ["one", "two"]


def test_a_first_write_that_fails_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(LareError, match="No space left on device"):
        Recorder("Chase", "factors", path=tmp_path / "talk.json").take("candidate", KNOWN, "one", "Somebody")
    assert not list(tmp_path.iterdir())


def test_the_same_request_at_two_times_has_two_replies():
    other, later = EXCHANGE | {"messages": [], "replies": ["else"]}, EXCHANGE | {"replies": ["three"]}
    again = RECORDING | {"exchanges": [EXCHANGE, other, later]}
    model = RecordedModel([read_recording(json.dumps(again), "Chase.draw3.json")], "Chase")
    assert [model.reply(KNOWN, sample) for sample in range(3)] == ["one", "two", "three"]
