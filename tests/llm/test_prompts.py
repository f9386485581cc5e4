"""Requests: those that were recorded come out again, byte for byte."""

import pytest

from lare_rl.envs.load import read_task
from lare_rl.llm.prompts import candidate, combine, correct
from lare_rl.llm.recording import SHIPPED, read_recording

RECORDINGS = sorted(f"{kind.name}/{entry.name}" for kind in SHIPPED.iterdir() for entry in kind.iterdir())
DIALOGUE = [{"role": "system", "content": "You write code."}, {"role": "user", "content": "Write some."}]


@pytest.mark.parametrize("name", RECORDINGS)
def test_every_recorded_request_comes_out_again(name):
    recording = read_recording((SHIPPED / name).read_text(encoding="utf-8"), name)
    task = read_task(recording.task)
    first, second = recording.exchanges
    assert first.stage == "candidate"
    assert candidate(task, recording.kind) == first.messages
    assert second.stage == "combine"
    assert combine(task, first.replies, recording.kind) == second.messages


def test_every_recording_is_where_its_name_says():
    for name in RECORDINGS:
        recording = read_recording((SHIPPED / name).read_text(encoding="utf-8"), name)
        assert name == f"{recording.kind}/{recording.task}.draw{recording.draw}.json"


def test_a_task_that_is_like_another_asks_for_the_same():
    assert candidate(read_task("HalfCheetahSparse-v4")) == candidate(read_task("HalfCheetah-v4"))


def test_candidate(chase):
    system, user = candidate(chase)
    assert system["role"] == "system"
    assert user == {
        "role": "user",
        "content": "# Task\nFollow the first entry.\n\n# Observation\n0: the target. 1: noise.\n\n# Action\n0: the guess.",
    }


def test_the_kinds_differ_only_in_the_role(chase):
    (role, user), (other_role, other_user) = candidate(chase, "factors"), candidate(chase, "reward")
    assert role != other_role
    assert user == other_user


def test_combine_numbers_the_attempts(chase):
    messages = combine(chase, ["  first\n", "second"])
    assert messages[:2] == candidate(chase)
    assert messages[2] == {"role": "assistant", "content": "Attempt 1:\nfirst\n\nAttempt 2:\nsecond"}
    assert messages[3]["content"].startswith("You have written several evaluation functions for this task.")


def test_correct_carries_the_reply_and_its_errors():
    assert correct(DIALOGUE, "\n my reply\n", " form: wrong\n") == [
        *DIALOGUE,
        {"role": "assistant", "content": "my reply"},
        {
            "role": "user",
            "content": "Your last evaluation function was run on recorded observations and actions of the task, and it "
            "failed:\nform: wrong\nCorrect it. The rules and the JSON form stay the same.",
        },
    ]
    assert len(DIALOGUE) == 2


@pytest.mark.parametrize("errors", ["KeyError: {error}", "{0} {} {{'a': 1}}", "100 % \\1"])
def test_braces_in_an_error_survive(errors):
    assert f"failed:\n{errors}\nCorrect it." in correct(DIALOGUE, "reply", errors)[-1]["content"]
