"""Verification: a table of broken functions and what is said of each, and that none of them ever runs here."""

import textwrap

import numpy as np
import pytest

from lare.latent import verify as verification
from lare.latent.verify import random_steps, verify
from lare.llm.client import SHIPPED, read_recording
from lare.llm.reply import parse
from lare.tasks.spec import read_task
from toys import PHI

RECORDINGS = sorted(f"{kind.name}/{entry.name}" for kind in SHIPPED.iterdir() for entry in kind.iterdir())
ORDER = ["runs", "form", "finite", "deterministic", "rows alone"]
NAMELESS = "NameError: the code defines no function evaluation_func(observation, action)"


def phi(body: str) -> str:
    return "def evaluation_func(observation, action):\n" + textwrap.indent(body, "    ")


@pytest.mark.parametrize(
    ("source", "failing", "message"),
    [
        ("", "runs", NAMELESS),
        ("evaluation_func = 3", "runs", NAMELESS),
        ("def reward(observation, action):\n    return [action]", "runs", NAMELESS),
        (
            "def evaluation_func(observation):\n    return [observation]",
            "runs",
            "TypeError: evaluation_func() takes 1 positional argument but 2 were given",
        ),
        (phi("x = 1\nreturn [undefined]"), "runs", "NameError: name 'undefined' is not defined (line 3)"),
        (phi("raise ValueError('no idea')"), "runs", "ValueError: no idea (line 2)"),
        (
            phi("return evaluation_func(action)"),
            "runs",
            "TypeError: evaluation_func() missing 1 required positional argument: 'action' (line 2)",
        ),
        (
            "import os\n" + phi("return [action]"),
            "runs",
            "ImportError: only numpy and math can be imported, not os (line 1)",
        ),
        (phi("from os import path"), "runs", "ImportError: only numpy and math can be imported, not os (line 2)"),
        (phi("open('x')"), "runs", "NameError: name 'open' is not defined (line 2)"),
        (phi("pass"), "form", "evaluation_func must return a list of arrays, but returned a NoneType"),
        (
            phi("return action"),
            "form",
            "evaluation_func must return a list of arrays, but returned an array of shape (256, 1) and type float32",
        ),
        (phi("return []"), "form", "evaluation_func must return 1 to 32 factors, but returned 0"),
        (phi("return [action] * 33"), "form", "evaluation_func must return 1 to 32 factors, but returned 33"),
        (
            phi("return [action, 1.0]"),
            "form",
            "factor 2 must be an array of shape (batch_size, 1) = (256, 1), but is a float",
        ),
        (
            phi("return [action[:, 0]]"),
            "form",
            "factor 1 must be an array of shape (batch_size, 1) = (256, 1), but is an array of shape (256,) "
            "and type float32",
        ),
        (
            phi("return [action, observation]"),
            "form",
            "factor 2 must be an array of shape (batch_size, 1) = (256, 1), but is an array of shape (256, 2) "
            "and type float32",
        ),
        (
            phi("return [action.astype('U4')]"),
            "form",
            "factor 1 must hold real numbers, but is an array of shape (256, 1) and type <U4",
        ),
        (
            phi("return [action * 1j]"),
            "form",
            "factor 1 must hold real numbers, but is an array of shape (256, 1) and type complex64",
        ),
        (
            phi("return [action, action * np.nan]"),
            "finite",
            "factor 2 is nan, which is no finite float32, for 256 of 256 recorded steps",
        ),
        (
            phi("return [np.abs(action) / 0]"),
            "finite",
            "factor 1 is inf, which is no finite float32, for 256 of 256 recorded steps",
        ),
        (
            phi("return [action + np.random.normal(size=action.shape)]"),
            "deterministic",
            "the same steps have other factors at a second call: a factor must not depend on chance",
        ),
        (
            "calls = []\n" + phi("calls.append(1)\nreturn [action * len(calls)]"),
            "deterministic",
            "the same steps have other factors at a second call: a factor must not depend on chance",
        ),
        (
            phi("return [action - np.mean(action)]"),
            "rows alone",
            "row 0 has other factors when it is judged alone: a row must not depend on other rows",
        ),
        (
            phi("return [action] * min(len(action), 2)"),
            "rows alone",
            "2 factors for 256 rows, but 1 for one row",
        ),
        (
            phi("return [action if len(action) > 1 else action[0]]"),
            "rows alone",
            "factor 1 must be an array of shape (batch_size, 1) = (1, 1), but is an array of shape (1,) and type float32",
        ),
    ],
)
def test_a_broken_function_is_refused(chase, source, failing, message):
    verdict = verify(source, chase)
    assert not verdict.passed
    assert verdict.errors == f"{failing}: {message}"
    assert verdict.size == 0
    # Those before it passed, and none came after it.
    assert [check.name for check in verdict.checks] == ORDER[: ORDER.index(failing) + 1]


def test_a_syntax_error_names_its_line(chase):
    verdict = verify("import numpy as np\ndef evaluation_func(observation, action)\n    return [action]", chase)
    assert [check.name for check in verdict.checks] == ["runs"]
    assert verdict.errors.startswith("runs: SyntaxError: expected ':'")
    assert verdict.errors.endswith("(line 2)")


@pytest.mark.parametrize("count", [2, 0])
def test_a_reward_is_exactly_one(chase, count):
    assert verify(phi("return [action]"), chase, "reward").passed
    said = "exactly one reward array" if count else "1 to 32 factors"
    verdict = verify(phi(f"return [action] * {count}"), chase, "reward")
    assert verdict.errors == f"form: evaluation_func must return {said}, but returned {count}"


@pytest.mark.parametrize(
    ("source", "size"),
    [
        (PHI, 2),
        (phi("return (action,)"), 1),
        (phi("return [action] * 32"), 32),
        (phi("return [action > 0, (action > 0).astype(np.int64), action.astype(np.float64)]"), 3),
        (phi("return [np.log(np.abs(action) + math.e)]"), 1),
        ("import math\nfrom numpy import tanh\n" + phi("return [tanh(action) * math.pi]"), 1),
    ],
)
def test_a_sound_function_passes_every_check(chase, source, size):
    verdict = verify(source, chase)
    assert verdict.errors == ""
    assert verdict.passed
    assert [check.name for check in verdict.checks] == ORDER
    assert verdict.size == size


@pytest.mark.parametrize("name", RECORDINGS)
def test_every_recorded_combination_passes(name):
    recording = read_recording((SHIPPED / name).read_text(encoding="utf-8"), name)
    source = parse(recording.exchanges[-1].replies[0]).functions
    verdict = verify(source, read_task(recording.task), recording.kind)
    assert verdict.errors == ""
    assert verdict.passed


def test_writing_into_the_input_spoils_no_other_check(chase):
    # Were the second call given the same arrays, its factors would differ.
    verdict = verify(phi("observation += 1\naction *= 2\nreturn [observation[:, 0:1] + action]"), chase)
    assert verdict.errors == ""
    assert verdict.passed


def test_an_endless_loop_is_stopped(chase, monkeypatch):
    monkeypatch.setattr(verification, "TIME_LIMIT", 2.0)
    verdict = verify(phi("while True:\n    pass"), chase)
    assert not verdict.passed
    assert verdict.errors == "time: the function did not finish within 2 s"


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("np.f2py.os._exit(7)", "exit status 7"),
        ("np.f2py.os._exit(0)", "exit status 0"),
        ("np.f2py.os.abort()", "exit status -6"),
        ("np.f2py.os.write(2, b'help!')\nnp.f2py.os._exit(7)", "help!"),
        ("np.f2py.sys.stdout.write('{}')\nreturn [action]", "exit status 0"),
    ],
)
def test_a_process_that_dies_is_a_failure(chase, body, message):
    verdict = verify(phi(body), chase)
    assert not verdict.passed
    assert verdict.errors == f"runs: the process that ran the function broke off: {message}"


def test_nothing_is_executed_in_this_process(chase):
    marking = "np.marked_by_phi = 1\n" + phi("np.marked_by_phi += 1\nreturn [action * (np.marked_by_phi > 1)]")
    assert verify(marking, chase).passed
    assert not hasattr(np, "marked_by_phi")


def test_the_process_sees_nothing_of_this_ones_environment(chase, monkeypatch):
    monkeypatch.setenv("MY_API_KEY", "secret")
    verdict = verify(phi("raise ValueError(list(np.f2py.os.environ))"), chase)
    assert verdict.errors.startswith("runs: ValueError: [")
    assert "MY_API_KEY" not in verdict.errors
    assert "PATH" not in verdict.errors


def test_random_steps_are_the_tasks_and_always_the_same(chase):
    observation, action = random_steps(chase, steps=50)
    assert (observation.shape, action.shape) == ((50, 2), (50, 1))
    assert (observation.dtype, action.dtype) == (np.float32, np.float32)
    assert np.abs(observation).max() <= 1
    assert 1 < np.abs(action).max() <= 2
    # Episodes of 20 steps: there was a reset in between, and every step is a new one.
    assert len(np.unique(observation[:, 0])) == 50
    for one, again in zip((observation, action), random_steps(chase, steps=50), strict=True):
        np.testing.assert_array_equal(one, again)
    assert not np.array_equal(action, random_steps(chase, steps=50, seed=1)[1])


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


@pytest.mark.parametrize("factor", METHODS_OF_ARRAYS)
def test_the_methods_of_arrays_can_be_used(chase, factor):
    # NumPy imports parts of itself when they are first called, through the import that generated code is given.
    assert verify(phi(f"return [{factor}]"), chase).errors == ""
