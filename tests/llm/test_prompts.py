"""Requests to a model: the recorded ones can be built again, byte for byte."""

import pytest

from lare_rl.envs.load import read_task
from lare_rl.llm.prompts import candidate, combine, correct
from lare_rl.llm.recording import SHIPPED_RECORDINGS, read_recording

DIALOGUE = [{"role": "system", "content": "You write code."}, {"role": "user", "content": "Write some."}]


def test_recorded_requests():
    kinds = [SHIPPED_RECORDINGS / kind for kind in ("factors", "reward")]
    names = [f"{kind.name}/{entry.name}" for kind in kinds for entry in kind.iterdir()]
    assert len(names) > 50
    for name in names:
        recording = read_recording((SHIPPED_RECORDINGS / name).read_text(encoding="utf-8"), name)
        task = read_task(recording.task)
        first, second, *corrections = recording.exchanges
        assert (first.stage, second.stage) == ("candidate", "combine"), name
        assert {exchange.stage for exchange in corrections} <= {"correct"}, name
        assert candidate(task, recording.kind) == first.messages, name
        conversation = second.messages[2]["content"]  # only candidates that passed are combined
        combined = [reply for reply in first.replies if reply.strip() in conversation]
        assert combine(task, combined, recording.kind) == second.messages, name
        assert name == f"{recording.kind}/{recording.task}.draw{recording.draw}.json"


@pytest.mark.parametrize(
    ("task", "other"),
    [("HalfCheetahSparse-v4", "HalfCheetah-v4"), ("HalfCheetah-v5", "HalfCheetah-v4"), ("Walker2d-v5", "Walker2d-v4")],
)
def test_tasks_with_the_same_observation_have_the_same_request(task, other):
    """So they share their recordings."""
    assert candidate(read_task(task)) == candidate(read_task(other))


@pytest.mark.parametrize("errors", ["form: wrong", "KeyError: {error}", "{0} {} {{'a': 1}}", "100 % \\1"])
def test_correct(errors):
    *dialogue, answer, request = correct(DIALOGUE, "\n my reply\n", f" {errors}\n")
    assert dialogue == DIALOGUE
    assert answer == {"role": "assistant", "content": "my reply"}
    assert f"failed:\n{errors}\nCorrect it." in request["content"]
