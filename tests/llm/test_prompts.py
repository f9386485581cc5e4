"""Requests to a model: the recorded ones can be built again, byte for byte."""

from pathlib import Path

import pytest

from lare_rl.envs.load import read_task
from lare_rl.llm.prompts import candidate, combine, correct
from lare_rl.llm.recording import SHIPPED_RECORDINGS, read_recording

REAL = Path(__file__).parents[2] / "benchmarks" / "real"
DIALOGUE = [{"role": "system", "content": "You write code."}, {"role": "user", "content": "Write some."}]


def test_recorded_requests():
    """The shipped recordings, and the recordings of the real simulators."""
    shipped = [entry for kind in ("factors", "reward") for entry in (SHIPPED_RECORDINGS / kind).iterdir()]
    real = list((REAL / "recordings").iterdir())
    assert (len(shipped) > 50, len(real)) == (True, 10)
    for entry in (*shipped, *real):
        recording = read_recording(entry.read_text(encoding="utf-8"), entry.name)
        assert entry.name == f"{recording.task}.draw{recording.draw}.json"
        task = read_task(str(REAL / "tasks" / f"{recording.task.lower()}.toml") if entry in real else recording.task)
        first, second, *corrections = recording.exchanges
        assert (first.stage, second.stage) == ("candidate", "combine"), entry.name
        assert {exchange.stage for exchange in corrections} <= {"correct"}, entry.name
        assert candidate(task, recording.kind) == first.messages, entry.name
        conversation = second.messages[2]["content"]  # only candidates that passed are combined
        combined = [reply for reply in first.replies if reply.strip() in conversation]
        assert combine(task, combined, recording.kind) == second.messages, entry.name


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
