"""Verification from end to end: gate, workers and checks, and that no program ever runs here."""

import re
import time

import numpy as np
import pytest

from lare.errors import LareError
from lare.latent.language.gate import inspect
from lare.latent.sandbox.isolation import around
from lare.latent.sandbox.jailed import JailedProgram, Returned, WorkerFailed
from lare.latent.verification import verify as verification
from lare.latent.verification.checks import CHECKS, Check
from lare.latent.verification.verify import random_steps, verify
from lare.llm.recording import SHIPPED, read_recording
from lare.llm.reply import parse
from lare.tasks.load import read_task
from tiers import long
from toys import PHI, phi, toy_spec

RECORDINGS = {
    f"{kind.name}/{entry.name}": read_recording(entry.read_text(encoding="utf-8"), entry.name)
    for kind in sorted(SHIPPED.iterdir(), key=lambda one: one.name)
    for entry in sorted(kind.iterdir(), key=lambda one: one.name)
}
RECORDED = [name if name.startswith("reward/") and "draw0" in name else long(name) for name in RECORDINGS]
"""`test_design.py` verifies the first draw of every task's factors."""
ORDER = ["gate", *CHECKS]


@pytest.mark.parametrize(
    ("source", "found", "errors"),
    [
        (
            phi("raise ValueError(np.load('x'))"),
            ["gate"],
            ["E-CONSTRUCT line 2: raise is not available"],
        ),
        (
            "import os\n" + phi("while True: pass\nreturn [action]"),
            ["gate"],
            [
                "E-IMPORT line 1: import os: only `import numpy as np` and `import math` are available",
                "E-CONSTRUCT line 3: while is not available",
            ],
        ),
        ("(" * 41, ["gate"], ["E-SIZE line 1: brackets are nested more than 40 deep"]),
        (
            phi("return [action]\nbreak"),
            ["gate", "runs"],
            ["E-RUN line 3: SyntaxError: 'break' outside loop"],
        ),
        (
            "X = [1][1:][0]\n" + phi("return [action]"),
            ["gate", "runs"],
            ["E-RUN line 1: IndexError: list index out of range"],
        ),
        (
            phi("return [action[:, 0]]"),
            ["gate", "runs", "form"],
            [
                "E-FORM: factor 1 must be an array of shape (batch_size, 1) = (256, 1), "
                "but is an array of shape (256,) and type float32: write [:, i:i + 1] for the column of entry i, because "
                "[:, i] has only one dimension"
            ],
        ),
        (
            phi("for row in action: pass\nx = action * np.sign(action[0])\nif x[0, 0] > 0: x = x + 1\nreturn [x]"),
            ORDER,
            [
                "E-FLOW line 4: a decision depends on values of the batch: use np.where instead of if, and, or, max, min",
                "E-LOOP: it makes 65 turns for 64 rows and 1032 for 1031: no loop over the batch, use whole arrays",
                "E-ROWS line 3: numbers of two rows meet: compute along axis=1, never over the batch",
                "E-BATCH: a step has other factors in a batch of 3 than in one of 256",
                "E-EMPTY: a batch without rows: "
                "E-RUN line 3: IndexError: index 0 is out of bounds for axis 0 with size 0",
            ],
        ),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said(chase, source, found, errors):
    verdict = verify(source, chase)
    assert not verdict.passed
    assert verdict.errors.splitlines() == errors
    assert [check.name for check in verdict.checks] == found
    assert (verdict.size, verdict.advice) == (0, ())


def test_a_sound_function_passes_every_check(chase, layers):
    verdict = verify(PHI, chase)
    assert verdict.errors == ""
    assert verdict.passed
    assert verdict.checks == tuple(Check(name, True, "") for name in ORDER)
    assert (verdict.size, verdict.advice) == (2, ())
    assert verdict.isolation == around(layers)


def test_advice_is_no_error(chase):
    verdict = verify(phi("still = 0 * action\nagain = -2 * action\nreturn [action, still, again]"), chase)
    assert verdict.passed
    assert verdict.advice == (
        "factor 'still' never varies on the recorded steps",
        "factor 'again' repeats 'action' on the recorded steps",
    )


def test_what_is_not_proved_is_said(chase):
    verdict = verify(phi("return [np.outer(action[:, 0], np.ones(1))]"), chase)
    assert verdict.passed
    assert verdict.advice == ("the independence of rows was tested, not proved: np.outer in line 2",)


def test_a_reward_is_exactly_one(chase):
    verdict = verify(PHI, chase, "reward")
    assert verdict.errors == "E-FORM: evaluation_func must return exactly one reward array, but returned 2"


METHODS_OF_ARRAYS = """
observation.mean(axis=1, keepdims=True)
observation.sum(1, keepdims=True)
observation.max(1, keepdims=True)
observation.std(1, keepdims=True)
observation.prod(1, keepdims=True)
(observation > 0).all(1, keepdims=True)
observation.clip(0, 1)[:, 0:1]
observation.argmax(1)[:, None]
np.linalg.norm(observation, axis=1, keepdims=True)
np.any(observation > 0, 1, keepdims=True)
np.median(observation, 1, keepdims=True)
""".strip().splitlines()


def test_the_methods_of_arrays_can_be_used(chase):
    # NumPy imports parts of itself when they are first called, through the import that generated code is given.
    verdict = verify(phi(f"return [{', '.join(METHODS_OF_ARRAYS)}]"), chase)
    assert verdict.errors == ""
    assert verdict.size == len(METHODS_OF_ARRAYS)


@pytest.mark.parametrize("name", RECORDED)
def test_every_recorded_combination_passes(name):
    recording = RECORDINGS[name]
    source = parse(recording.exchanges[-1].replies[0]).functions
    verdict = verify(source, read_task(recording.task), recording.kind)
    assert verdict.errors == ""
    assert verdict.passed


def test_the_gate_lets_every_recorded_reply_through():
    replies = [
        (name, reply)
        for name, recording in RECORDINGS.items()
        for exchange in recording.exchanges
        for reply in exchange.replies
    ]
    assert len(replies) > 100
    found = [(name, *inspect(parse(reply).functions)) for name, reply in replies]
    assert [one for one in found if len(one) > 1] == []


def test_both_workers_end(chase, monkeypatch):
    started = []

    class Noted(JailedProgram):
        def __init__(self, *arguments, **options):
            started.append(self)
            super().__init__(*arguments, **options)

    monkeypatch.setattr(verification, "JailedProgram", Noted)
    assert verify(PHI, chase).passed
    verify(phi("return action"), chase)
    verify("x = 1", chase)
    assert len(started) == 2 + 2 + 1
    assert all(program.process.returncode is not None for program in started)


class Scripted:
    """Takes the place of `JailedProgram`: does in each call what the test wants."""

    isolation, problems, failed = "nothing", (), None

    def __init__(self, call):
        self.call = call

    def close(self):
        pass


def test_the_second_worker_must_give_the_same(chase, monkeypatch):
    def gives(number):
        def call(observation, action, mode="plain"):
            rows = len(action)
            factors = np.full((rows, 1), float(number))
            return Returned(None, None, (("array", (rows, 1), "float64"),), (), factors, 1, 0, ())

        return call

    workers = [Scripted(gives(1)), Scripted(gives(2))]
    monkeypatch.setattr(verification, "JailedProgram", lambda *_, **__: workers.pop(0))
    assert verify(PHI, chase).errors == (
        "E-CHANCE: the same steps have other factors in another process: a factor must not depend on chance"
    )


def test_a_worker_that_fails_is_a_failed_check(chase, monkeypatch):
    def call(*_):
        raise WorkerFailed("the process that runs the latent function failed: it did not answer within 30 s")

    monkeypatch.setattr(verification, "JailedProgram", lambda *_, **__: Scripted(call))
    verdict = verify(PHI, chase)
    assert not verdict.passed
    assert verdict.errors == ("E-RUN: the process that runs the latent function failed: it did not answer within 30 s")


def test_what_is_slow_only_at_some_size_does_not_take_minutes(chase, monkeypatch):
    for name, seconds in (("SLOWEST_CALL", 2.0), ("LONGEST", 4.0)):
        monkeypatch.setattr(verification, name, seconds)
    slow = "if action.shape[0] not in (1, 3, 16, 64, 256, 1031, 4096):\n    for i in range(900): x = x @ x * 1e-3\n"
    start = time.monotonic()
    verdict = verify(phi(f"x = np.ones((1500, 1500))\n{slow}return [action + 0 * x[0, 0]]"), chase)
    assert time.monotonic() - start < 10
    # On a busy machine the worker's traceback may come too late to be read.
    said = r"E-RUN: the process that runs the latent function failed: it did not answer within [012] s(, at line 4)?"
    assert re.fullmatch(said, verdict.errors)


def test_no_worker_to_be_had_is_no_verdict(chase, monkeypatch):
    monkeypatch.setattr("lare.latent.sandbox.jailed.START", "raise SystemExit('no such library')")
    with pytest.raises(LareError, match=r"\Athe process for the latent function does not start: "):
        verify(PHI, chase)


def test_nothing_is_executed_in_this_process(chase):
    # Not even if the gate were open: what a program does, it does to its own NumPy.
    program = JailedProgram("np.marked_by_phi = 1\n" + phi("return [action * np.marked_by_phi]"), 2, 1, gated=False)
    assert program.call(*random_steps(chase, steps=3)).factors.shape == (3, 1)
    program.close()
    assert not hasattr(np, "marked_by_phi")


def test_random_steps_are_the_tasks_and_always_the_same(chase):
    observation, action = random_steps(chase, steps=50)
    assert (observation.shape, action.shape) == ((50, 2), (50, 1))
    assert (observation.dtype, action.dtype) == (np.float32, np.float32)
    assert np.abs(observation).max() <= 1
    assert 1 < np.abs(action).max() <= 2
    # Episodes of 20 steps: there was a reset in between, and every step is a new one.
    assert len(np.unique(observation[:, 0])) == 50
    verification.known_steps.cache_clear()
    for one, again in zip((observation, action), random_steps(chase, steps=50), strict=True):
        np.testing.assert_array_equal(one, again)
    assert not np.array_equal(action, random_steps(chase, steps=50, seed=1)[1])


def test_random_steps_are_everybodys_and_nobody_writes_into_them(chase):
    for array in random_steps(chase, steps=50):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def test_another_task_has_other_steps(chase):
    longer = toy_spec(max_episode_steps=50)
    assert not np.array_equal(random_steps(chase, steps=50)[0], random_steps(longer, steps=50)[0])


def test_agents_that_have_left_have_no_random_steps():
    """Of two agents one acts twice in an episode of five steps, the other at each."""
    task = toy_spec(
        name="toy",
        environment="pettingzoo/parallel_toys:Toy",
        observation_size=2,
        action_size=3,
        arguments={"leaves": {"a_1": 2}},
    )
    observation, action = random_steps(task, steps=70)
    assert np.bincount(observation[:, 1].astype(int)).tolist() == [20, 20, 10, 10, 10]
    np.testing.assert_array_equal(action.sum(axis=1), 1)


@pytest.mark.parametrize(
    ("judges", "times"),
    [("before", [14, 14, 14, 14, 14]), ("after", [0, 14, 14, 14, 14, 14]), ("both", [7, 14, 14, 14, 14, 7])],
)
def test_random_steps_are_judged_as_the_task_says_and_reach_the_end(judges, times):
    task = toy_spec(
        name="toy", environment="pettingzoo/parallel_toys:Toy", observation_size=2, action_size=3, judges=judges
    )
    observation, _ = random_steps(task, steps=70)  # an observation says how much of an episode of five steps is over
    assert np.bincount(observation[:, 1].astype(int)).tolist() == times


def test_a_step_before_the_last_is_left_out_rather_than_the_end(chase):
    longer = toy_spec(max_episode_steps=1000)
    every, (observation, action) = random_steps(longer, steps=1000), random_steps(longer, steps=50)
    np.testing.assert_array_equal(observation[[0, -1]], every[0][[0, -1]])
    np.testing.assert_array_equal(action[[0, -1]], every[1][[0, -1]])


def test_an_agent_that_never_acts_cannot_be_judged():
    late = {"name": "toy", "environment": "pettingzoo/parallel_toys:Toy", "observation_size": 2, "action_size": 3}
    team = toy_spec(**late, arguments={"joins": {"a_1": 9}}, agents=("a_1",), team="late")
    with pytest.raises(LareError, match=r"^no agent of toy acted in 5120 steps of random actions$"):
        random_steps(team, steps=10)
