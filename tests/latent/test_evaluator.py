"""`phi` at work: batches of any size, computed again now and then, and what is said when it fails."""

import signal

import numpy as np
import pytest

from lare.errors import LareError
from lare.latent.evaluator import Evaluator, LatentRewardError
from lare.latent.language.program import Program
from lare.latent.sandbox.isolation import around
from lare.latent.sandbox.jailed import ROWS, SIZES, WorkerFailed
from toys import PHI, phi

NAMES = ["f_near", "f_effort"]


def batch(rows: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(rows)
    return random.standard_normal((rows, 2)).astype(np.float32), random.uniform(-1, 1, (rows, 1)).astype(np.float32)


@pytest.fixture
def evaluator():
    """Starts evaluators for one test."""
    started = []

    def start(source: str = PHI, names: tuple[str, ...] = ("f_near", "f_effort")) -> Evaluator:
        started.append(Evaluator(source, list(names), 2, 1))
        return started[-1]

    yield start
    for one in started:
        one.close()


@pytest.fixture(scope="module")
def near():
    one = Evaluator(PHI, NAMES, 2, 1)
    yield one
    one.close()


@pytest.mark.parametrize("rows", [0, 1, 3, ROWS - 1, ROWS, ROWS + 1, 2 * ROWS + 17])
def test_a_batch_of_any_size_has_the_factors_of_this_process(near, rows):
    factors = near(*batch(rows))
    assert factors.dtype == np.float32
    np.testing.assert_array_equal(factors, np.concatenate(Program(PHI)(*batch(rows)), axis=1))


def test_whatever_type_the_factors_have_they_become_float32(evaluator):
    source = phi("return [action > 0, (action * 9).astype(int), action.astype(float) / 3]")
    factors = evaluator(source, ("a", "b", "c"))(*batch(5))
    assert factors.dtype == np.float32
    np.testing.assert_array_equal(factors, np.concatenate(Program(source)(*batch(5)), axis=1).astype(np.float32))


def asked(evaluator: Evaluator) -> list[int]:
    """Notes the rows of every call of the worker from now on."""
    sizes = []
    call = evaluator.program.call

    def noting(observation, action):
        sizes.append(len(observation))
        return call(observation, action)

    evaluator.program.call = noting
    return sizes


def test_three_rows_are_computed_again_at_calls_1_2_4_8(evaluator):
    one = evaluator()
    sizes = asked(one)
    for _ in range(9):
        one(*batch(10))
    again = [16, 4]  # rows of the sizes that programs are verified with
    assert sizes == [*again, *again, 16, *again, 16, 16, 16, *again, 16]


def test_a_call_without_rows_has_none_to_compute_again(evaluator):
    one = evaluator()
    sizes = asked(one)
    one(*batch(0))
    assert sizes == [0]


SENTINEL = (
    "the latent function failed: the same steps have different factors when they are computed again in a smaller batch"
)


@pytest.mark.parametrize(
    "body",
    [
        "return [action + (len(action) == 4)]",
        "return [action - action.mean()]",
        "return [action * (1 + 1e-3 * (len(action) > 4))]",
        "return [np.where(np.arange(len(action))[:, None] == len(action) - 1, action + 1, action) * (len(action) > 4)]",
    ],
)
def test_who_depends_on_the_batch_is_found_by_it(evaluator, body):
    with pytest.raises(LatentRewardError) as error:
        evaluator(phi(body), ("a",))(*batch(50))
    assert str(error.value) == SENTINEL


@pytest.mark.parametrize("rows", [512, 3000])
def test_rows_are_witnesses_by_chance(evaluator, rows):
    # Nobody can leave just those rows alone that will be computed again.
    body = "rows = np.arange(len(action))[:, None]\nalone = (rows == 0) | (rows == 255) | (rows == 511) | (len(action) < 9)"
    one = evaluator(phi(f"{body}\nreturn [np.where(alone, action, action - np.mean(action))]"), ("a",))
    with pytest.raises(LatentRewardError) as error:
        one(*batch(rows))
    assert str(error.value) == SENTINEL


@pytest.mark.parametrize("rows", [1, 2, 3, 5, 255, 256, 257, ROWS, ROWS + 1])
def test_a_program_meets_only_sizes_that_it_was_verified_with(evaluator, rows):
    one = evaluator()
    sizes = asked(one)
    factors = one(*batch(rows))
    assert {*sizes} <= {*SIZES}
    assert len(factors) == rows


def test_an_offset_hides_no_other_rows(evaluator):
    body = "return [1e4 + 0.4 * np.roll(np.tanh(observation[:, 0:1]), 2, axis=0)]"
    with pytest.raises(LatentRewardError, match="have different factors when they are computed again"):
        evaluator(phi(body), ("a",))(*batch(50))


def test_a_large_factor_hides_no_small_one(evaluator):
    with pytest.raises(LatentRewardError, match="have different factors when they are computed again"):
        evaluator(phi("return [1e7 * observation[:, 0:1], action + (len(action) == 4)]"), ("a", "b"))(*batch(50))


def test_the_last_digits_may_differ(evaluator):
    # As they do in matrix products of another size.
    evaluator(phi("return [action * (1 + 1e-6 * (len(action) == 4))]"), ("a",))(*batch(50))


@pytest.mark.parametrize(
    ("body", "names", "message"),
    [
        ("return [action[0:3]]", "a", "E-FORM: factor 1 must be an array of shape "
         "(batch_size, 1) = (8, 1), but is an array of shape (3, 1) and type float32"),
        ("x = 1\nreturn [[action][x]]", "a", "E-RUN line 3: IndexError: list index out of range"),
        ("return action", "a", "E-FORM: evaluation_func must return a list of arrays, "
         "but returned an array of shape (8, 1) and type float32"),
        ("return []", "a", "E-FORM: evaluation_func must return 1 to 32 factors, but returned 0"),
        ("return [action, action]", "a", "it gave 2 factors, not 1"),
        ("return [action]", "ab", "it gave 1 factors, not 2"),
        ("return [action, np.sqrt(observation[:, 0:1])]", "ab", "factor 'b' is nan for the observation [-2.    0.25]"),
        ("return [1e39 * (observation[:, 0:1] < 0)]", "a",
         "factor 'a' is inf for the observation [-2.    0.25]"),
        ("return [1 / (action - action)]", "a", "factor 'a' is inf for the observation [1. 1.]"),
        ("for i in range(19_999): i - 1\nfor i in range(9): i - 1", "a",
         "E-RUN line 3: OutOfFuel: more than 20000 turns of loops and calls"),
    ],
)  # fmt: skip
def test_a_failure_carries_its_batch(evaluator, body, names, message):
    observation, action = np.ones((7, 2), np.float32), np.ones((7, 1), np.float32)
    observation[4] = -2, 0.25
    one = evaluator(phi(body), tuple(names))
    with pytest.raises(LatentRewardError) as error:
        one(observation, action)
    assert str(error.value) == f"the latent function failed: {message}"
    assert error.value.observation is observation
    assert error.value.action is action


def test_the_number_of_factors_may_not_change_within_a_batch(evaluator):
    one = evaluator(phi("return [action] * (1 + (len(action) < 9))"), ("a",))
    with pytest.raises(LatentRewardError, match=r"it gave [12] factors, not 1"):
        one(*batch(ROWS + 5))


def test_a_worker_that_was_killed_is_a_failure_with_its_batch(evaluator):
    one = evaluator()
    one(*batch(3))
    one.program.process.send_signal(signal.SIGKILL)
    one.program.process.wait()
    observation, action = batch(2)
    with pytest.raises(LatentRewardError, match=r"\Athe process that runs the latent function failed: ") as error:
        one(observation, action)
    assert error.value.observation is observation
    assert error.value.action is action


def test_what_the_gate_refuses_is_never_at_work():
    with pytest.raises(LareError) as error:
        Evaluator(phi("return [np.load('x')]"), ["a"], 2, 1)
    assert str(error.value).startswith(
        "the latent function does not pass the gate: E-NUMPY line 2: np.load is not available: "
    )


def test_isolation(near, layers):
    assert near.isolation == around(layers)


def test_closed_it_does_not_work(evaluator):
    one = evaluator()
    one.close()
    assert one.program.process.returncode is not None
    with pytest.raises(LatentRewardError) as error:
        one(*batch(1))
    assert isinstance(error.value.__cause__, WorkerFailed)
