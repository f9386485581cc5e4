"""The loop of candidates, combination and correction: what is asked, what is kept, and when it gives up."""

import json

import pytest

from lare.errors import LareError
from lare.latent.design import ATTEMPTS, design
from lare.llm.prompts import candidate, combine, correct
from lare.tasks.spec import read_task, shipped_tasks
from toys import PHI, toy_spec


def reply(source: str) -> str:
    return json.dumps({"Understand": "u", "Analyze": "a", "Functions": source})


def failing(said: str) -> str:
    return reply(f"def evaluation_func(observation, action):\n    raise ValueError('{said}')")


GOOD = reply(PHI)
MALFORMED = "Here is the function."
NOT_JSON = "the reply is not one JSON object: Expecting value: line 1 column 1 (char 0)"


class Scripted:
    """A model that says its lines, and remembers what it was asked."""

    name = "scripted"

    def __init__(self, *lines: str):
        self.lines = list(lines)
        self.asked = []

    def reply(self, messages, sample):
        self.asked.append((list(messages), sample))
        return self.lines.pop(0)


@pytest.mark.parametrize("name", shipped_tasks())
def test_every_shipped_task_has_its_function(name):
    function = design(read_task(name))
    assert function.task == name
    assert function.model == "Claude (Anthropic), recorded 2026-11-20, draw 0"
    assert [exchange["stage"] for exchange in function.exchanges] == ["candidate", "combine"]
    assert function.size == len(set(function.names)) > 1
    assert function.checks
    assert all(check.passed for check in function.checks)


def test_draws_are_different_samples():
    functions = [design(read_task("Reacher-v4"), draw=draw) for draw in (0, 1)]
    assert functions[0].digest != functions[1].digest


def test_a_reward_is_one_factor():
    function = design(read_task("Reacher-v4"), "reward")
    assert (function.kind, function.size) == ("reward", 1)


def test_a_failure_goes_back_with_its_error(chase):
    bad = failing("no idea")
    model = Scripted("first", "second", bad, GOOD)
    function = design(chase, model=model, candidates=2)
    first = candidate(chase)
    second = combine(chase, ["first", "second"])
    third = correct(second, bad, "runs: ValueError: no idea (line 2)")
    assert model.asked == [(first, 0), (first, 1), (second, 0), (third, 0)]
    assert function.exchanges == (
        {"stage": "candidate", "messages": first, "replies": ["first", "second"]},
        {"stage": "combine", "messages": second, "replies": [bad]},
        {"stage": "correct", "messages": third, "replies": [GOOD]},
    )
    assert (function.source, function.model) == (PHI.strip("\n"), "scripted")


def test_one_candidate_is_not_combined(chase):
    model = Scripted(GOOD)
    function = design(chase, model=model, candidates=1)
    assert model.asked == [(candidate(chase), 0)]
    assert [exchange["stage"] for exchange in function.exchanges] == ["candidate"]


def test_a_malformed_reply_can_be_corrected(chase):
    model = Scripted(MALFORMED, GOOD)
    design(chase, model=model, candidates=1)
    assert model.asked[1] == (correct(candidate(chase), MALFORMED, NOT_JSON), 0)


def test_the_kind_is_what_is_asked_and_checked(chase):
    one = reply("def evaluation_func(observation, action):\n    return [action]")
    model = Scripted(GOOD, one)
    function = design(chase, "reward", model=model, candidates=1)
    error = "form: evaluation_func must return exactly one reward array, but returned 2"
    assert [messages for messages, _ in model.asked] == [
        candidate(chase, "reward"),
        correct(candidate(chase, "reward"), GOOD, error),
    ]
    assert (function.kind, function.size) == ("reward", 1)


def test_it_gives_up_with_the_last_errors(chase):
    bad = [failing(f"attempt {number}") for number in range(1, ATTEMPTS + 1)]
    model = Scripted(*bad, GOOD)
    with pytest.raises(LareError) as error:
        design(chase, model=model, candidates=1)
    assert str(error.value) == (
        "task 'Chase': none of 5 attempts passed; the last one failed: runs: ValueError: attempt 5 (line 2)"
    )
    assert model.lines == [GOOD]
    # Each request carries all the failures before it.
    last, _ = model.asked[-1]
    assert [message["content"] for message in last if message["role"] == "assistant"] == bad[:-1]


def test_the_last_attempt_may_be_the_good_one(chase):
    model = Scripted(*[MALFORMED] * (ATTEMPTS - 1), GOOD)
    assert len(design(chase, model=model, candidates=1).exchanges) == ATTEMPTS


def test_a_task_without_recordings_is_refused():
    with pytest.raises(
        LareError, match=r"\Ano recorded reply fits this request for task 'Chase' \(reply 1\): [^\n]+\Z"
    ):
        design(toy_spec())


@pytest.mark.parametrize("n", [0, -1])
def test_too_few_candidates(chase, n):
    with pytest.raises(LareError, match=f"candidates = {n}"):
        design(chase, candidates=n)
