"""The dynamic checks: a table of programs that are wrong in one way each, and the exact message of each.

Most of them are plain functions in this process, which take the place of a worker; what comes at the end runs in one.
"""

import dataclasses
import itertools
import json
from pathlib import Path

import numpy as np
import pytest

from lare.latent.sandbox.jailed import ROWS, SIZES, JailedProgram, Returned
from lare.latent.verification import checks
from lare.latent.verification.checks import CHECKS, Check, Failed, Trial, advice, examine

STEPS = 256


class Stand:
    """Stands in for a worker: calls a function here, and describes what it returned as a worker would."""

    def __init__(self, function, *, strict=None, oblivious=None, steps=lambda rows: 1, peak=lambda rows: 100 * rows):
        self.functions = {"plain": function, "strict": strict or function, "oblivious": oblivious or function}
        self.steps, self.peak = steps, peak
        self.asked = []

    def call(self, observation, action, mode="plain"):
        rows = len(observation)
        self.asked.append((rows, observation.dtype, mode))
        measured = {"steps": self.steps(rows), "peak": self.peak(rows) if mode == "traced" else 0, "events": ()}
        try:
            with np.errstate(all="ignore"):
                values = self.functions.get(mode, self.functions["plain"])(observation, action)
        except Exception as error:  # whatever a program of somebody else's does
            said, line = f"{type(error).__name__}: {error}", 7
            return Returned(error=said, line=line, values=None, instead=(), factors=None, **measured)
        if not isinstance(values, list):
            return Returned(error=None, line=None, values=None, instead=described(values), factors=None, **measured)
        described_values = tuple(map(described, values[:33]))
        factors = None
        if 1 <= len(values) <= 32 and all(one[1:2] == ((rows, 1),) and one[2][0] in "fiub" for one in described_values):
            factors = np.concatenate([np.asarray(value, np.float64) for value in values], axis=1)
        return Returned(error=None, line=None, values=described_values, instead=(), factors=factors, **measured)


def described(value) -> tuple:
    if isinstance(value, np.ndarray):
        return "array", value.shape, str(value.dtype)
    return (type(value).__name__,)


def sound(observation, action):
    return [observation[:, 0:1] * 2, np.square(action)]


def trial(function=sound, again=None, kind="factors", **stand) -> Trial:
    random = np.random.default_rng(1)
    observation = random.uniform(-0.9, 0.9, (STEPS, 2)).astype(np.float32)
    action = random.uniform(-0.9, 0.9, (STEPS, 1)).astype(np.float32)
    return Trial(Stand(function, **stand), Stand(again or function), observation, action, kind)


def message(name: str, one: Trial) -> str:
    """What one check says against a trial; nothing if it passes."""
    try:
        CHECKS[name](one)
    except Failed as failure:
        return str(failure)
    return ""


def failing(said):
    def function(observation, action):
        raise ValueError(said)

    return function


@pytest.mark.parametrize("name", CHECKS)
def test_a_sound_function_passes(name):
    assert message(name, trial()) == ""


def test_runs():
    assert message("runs", trial(failing("no idea"))) == "E-RUN line 7: ValueError: no idea"
    assert message("runs", trial(failing("output array is read-only"))) == (
        "E-RUN line 7: ValueError: output array is read-only (the inputs cannot be written into: copy them first)"
    )
    ambiguous = "The truth value of an array with more than one element is ambiguous. Use a.any() or a.all()"
    assert message("runs", trial(failing(ambiguous))) == (
        f"E-RUN line 7: ValueError: {ambiguous} (a condition may hold for some rows only: use np.where instead of if)"
    )


WANTED = "factor {} must be an array of shape (batch_size, 1) = (256, 1), but is {}"
ONE_DIMENSION = ": write [:, i:i + 1] for the column of entry i, because [:, i] has only one dimension"


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (lambda o, a: None, "evaluation_func must return a list of arrays, but returned a NoneType"),
        (
            lambda o, a: a,
            "evaluation_func must return a list of arrays, but returned an array of shape (256, 1) and type float32",
        ),
        (lambda o, a: [], "evaluation_func must return 1 to 32 factors, but returned 0"),
        (lambda o, a: [a] * 33, "evaluation_func must return 1 to 32 factors, but returned more than 32"),
        (lambda o, a: [a] * 99, "evaluation_func must return 1 to 32 factors, but returned more than 32"),
        (lambda o, a: [a, 1.5], WANTED.format(2, "a float")),
        (lambda o, a: [a, np.float32(1)], WANTED.format(2, "a float32")),
        (lambda o, a: [[a]], WANTED.format(1, "a list")),
        (lambda o, a: [a[:, 0]], WANTED.format(1, f"an array of shape (256,) and type float32{ONE_DIMENSION}")),
        (lambda o, a: [a, o], WANTED.format(2, "an array of shape (256, 2) and type float32")),
        (lambda o, a: [a.T], WANTED.format(1, "an array of shape (1, 256) and type float32")),
        (
            lambda o, a: [o[:, 7:8]],
            WANTED.format(1, "an array of shape (256, 0) and type float32: a slice beyond the last column is empty"),
        ),
        (
            lambda o, a: [a.astype(complex)],
            "factor 1 must hold real numbers, but is an array of shape (256, 1) and type complex128",
        ),
        (
            lambda o, a: [a, a.astype(object)],
            "factor 2 must hold real numbers, but is an array of shape (256, 1) and type object",
        ),
        (
            lambda o, a: [a] * min(len(a), 3),
            "the number of factors depends on the batch: 3 for 256 rows, 3 for 64 rows, 1 for 1 rows, 3 for 1031 rows",
        ),
        (
            lambda o, a: [a] * (1 + (len(a) > 1000)),
            "the number of factors depends on the batch: 1 for 256 rows, 1 for 64 rows, 1 for 1 rows, 2 for 1031 rows",
        ),
    ],
)
def test_form(function, said):
    assert message("form", trial(function)) == f"E-FORM: {said}"


def test_form_of_an_error_in_a_batch_of_another_size():
    def function(observation, action):
        return sound(observation, action) if len(action) > 1 else failing("one row")(observation, action)

    assert message("form", trial(function)) == "E-RUN line 7: ValueError: one row"


@pytest.mark.parametrize("count", [0, 1, 2, 40])
def test_a_reward_is_exactly_one(count):
    said = message("form", trial(lambda o, a: [a] * count, kind="reward"))
    returned = "more than 32" if count > 32 else count
    assert said == (
        "" if count == 1 else f"E-FORM: evaluation_func must return exactly one reward array, but returned {returned}"
    )


@pytest.mark.parametrize("dtype", [bool, np.int8, np.uint16, np.int64, np.float16, np.float32, np.float64])
def test_real_numbers_of_any_type_will_do(dtype):
    assert message("form", trial(lambda o, a: [np.abs(a).astype(dtype)])) == ""


def raising(kind):
    """What happens on arrays that refuse to be looked into."""

    def function(observation, action):
        raise type(kind, (Exception,), {})("what it did")

    return function


def test_control_flow():
    assert message("control flow", trial(oblivious=raising("Looked"))) == "E-FLOW line 7: what it did"
    assert message("control flow", trial(oblivious=raising("Missing"))) == "E-INDEX line 7: what it did"


def test_loops():
    assert message("loops", trial(steps=lambda rows: 5)) == ""
    assert message("loops", trial(steps=lambda rows: rows + 1)) == (
        "E-LOOP: it makes 65 turns for 64 rows and 1032 for 1031: no loop over the batch, use whole arrays"
    )
    assert message("loops", trial(steps=lambda rows: 1 + (rows > 1000))) == (
        "E-LOOP: it makes 1 turns for 64 rows and 2 for 1031: no loop over the batch, use whole arrays"
    )


def where(condition, value):
    """A function whose factor is a value where a condition of both inputs holds."""
    return lambda o, a: [a, np.where(condition(o, a), value, np.float64(0.0)).reshape(-1, 1)]


def all_are(number):
    return lambda o, a: (o == number).all(axis=1) & (a == number).all(axis=1)


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (where(lambda o, a: o[:, 0] < 9, np.nan), "factor 2 is nan for 256 of 256 recorded steps"),
        (where(lambda o, a: np.arange(len(o)) == 5, -np.inf), "factor 2 is -inf for 1 of 256 recorded steps"),
        (where(lambda o, a: o[:, 0] < 9, 1e39), "factor 2 is 1e+39 for 256 of 256 recorded steps"),
        (where(lambda o, a: np.abs(o[:, 0]) > 2, np.nan), "factor 2 is nan for 9 of 256 random steps"),
        (where(all_are(0), np.nan), "factor 2 is nan for 256 of 256 steps of nothing but zeros"),
        (where(all_are(1), np.inf), "factor 2 is inf for 256 of 256 steps of nothing but ones"),
        (
            where(lambda o, a: (o.sum(1) + a.sum(1) == 1) & (a[:, 0] == 1), np.nan),
            "factor 2 is nan for 1 of 3 steps with a single one",
        ),
        (where(lambda o, a: (o[:, 0] == 1) & (o[:, 1] == 0), np.nan), "factor 2 is nan for 1 of 3 steps with a single one"),
        (where(lambda o, a: o[:, 0] > 800, np.inf), "factor 2 is inf for 13 of 256 recorded steps times 1000"),
        (
            where(lambda o, a: (np.abs(o[:, 0]) > 0) & (np.abs(o[:, 0]) < 1e-7), np.nan),
            "factor 2 is nan for 256 of 256 recorded steps times 1e-9",
        ),
        (where(lambda o, a: np.full(len(o), len(o) == 1), np.nan), "factor 2 is nan for 1 of 1 one recorded step"),
        (where(lambda o, a: np.full(len(o), len(o) == 2), np.nan), "factor 2 is nan for 2 of 2 two recorded steps"),
        (
            where(lambda o, a: np.full(len(o), o.dtype == np.float64), np.nan),
            "factor 2 is nan for 256 of 256 recorded steps",
        ),
    ],
)  # fmt: skip
def test_finite(function, said):
    assert message("finite", trial(function)) == f"E-FINITE: {said}"


def test_the_operation_that_was_not_finite_is_named():
    def strict(observation, action):
        raise FloatingPointError("divide by zero encountered in divide")

    assert message("finite", trial(lambda o, a: [a / 0], strict=strict)) == (
        "E-FINITE line 7: factor 1 is inf for 256 of 256 recorded steps (divide by zero encountered in divide)"
    )


def test_finite_is_asked_in_both_precisions():
    one = trial()
    assert message("finite", one) == ""
    kinds = [dtype for _, dtype, _ in one.program.asked]
    assert kinds == [np.float32] * 9 + [np.float64] * 9


def test_finite_of_an_error_on_steps_that_never_were():
    def function(observation, action):
        return failing("too large")(observation, action) if np.abs(observation).max() > 1 else [action]

    assert message("finite", trial(function)) == "E-RUN line 7: ValueError: too large"


OTHER = "E-CHANCE: the same steps have other factors {}: a factor must not depend on chance"


def test_deterministic():
    calls = itertools.count()
    assert message("deterministic", trial(lambda o, a: [a + next(calls)])) == OTHER.format("at a second call")
    assert message("deterministic", trial(again=lambda o, a: [a])) == OTHER.format("in another process")
    nearly = trial(again=lambda o, a: [np.nextafter(one, 9) for one in sound(o, a)])
    assert message("deterministic", nearly) == OTHER.format("in another process")


ALONG = "compute along axis=1, never over the batch"
ROWS_APART = f"E-ROWS: factor {{}} of a row depends on the other rows: {ALONG}"


@pytest.mark.parametrize(
    ("function", "number"),
    [
        (lambda o, a: [a, a - a.mean()], 2),
        (lambda o, a: [a / np.abs(a).max(), a], 1),
        (lambda o, a: [np.roll(a, 1, axis=0)], 1),
        (lambda o, a: [np.cumsum(a, axis=0)], 1),
        (lambda o, a: [np.full_like(a, np.linalg.norm(a))], 1),
        (lambda o, a: [a, a, np.argsort(a, axis=0)], 3),
        (lambda o, a: [a * (1 + 1e-7 * (a.max() > 1))], 1),
        (lambda o, a: [a + 1e-12 * a.astype(np.float64).sum()], 1),
        *[(lambda o, a, by=by: [np.roll(a, by, axis=0)], 1) for by in (2, 4, 64, 128, 255)],
        (lambda o, a: [1e4 + 0.4 * np.roll(np.tanh(a), 2, axis=0)], 1),
        (lambda o, a: [np.where(np.arange(len(a))[:, None] == 17, np.roll(a, 5, axis=0), a)], 1),
    ],
)
def test_rows_apart(function, number):
    assert message("rows apart", trial(function)) == ROWS_APART.format(number)


def test_rows_apart_cannot_see_the_size_of_the_batch():
    # That is why there is another check.
    assert message("rows apart", trial(lambda o, a: [a / len(a)])) == ""


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (lambda o, a: [a * np.sign(a[0])], "when the batch is in another order"),
        (lambda o, a: [a * np.arange(len(a))[:, None]], "when the batch is in another order"),
        *[
            (lambda o, a, rows=rows: [a + (len(a) == rows)], f"in a batch of {rows} than in one of 256")
            for rows in (1, 3, 16, ROWS)
        ],
        *[
            (lambda o, a, rows=rows: [a - a.mean() * (len(a) == rows)], f"in a batch of {rows} than in one of 256")
            for rows in SIZES[1:]
            if rows != 256
        ],
        (lambda o, a: [1e4 + 0.4 * np.roll(np.tanh(a), 2, axis=0)], "when the batch is in another order"),
        (lambda o, a: [1e4 + 0.4 * np.sign(np.arange(len(a)) % 2)[:, None]], "when the batch is in another order"),
        (lambda o, a: [a, a / len(a)], "in a batch of 1 than in one of 256"),
        (lambda o, a: [a * (1 + 1e-3 * (len(a) == 3))], "in a batch of 3 than in one of 256"),
    ],
)
def test_batch_sizes(function, said):
    assert message("batch sizes", trial(function)) == f"E-BATCH: a step has other factors {said}"


def test_batch_sizes_leave_the_last_digits_alone():
    assert message("batch sizes", trial(lambda o, a: [a * (1 + 1e-6 * (len(a) == 3)) + 1e-7 * (len(a) == 16)])) == ""


def test_cost_in_memory():
    assert message("cost", trial(peak=lambda rows: 1000 * rows)) == ""
    assert message("cost", trial(peak=lambda rows: 8 * rows * rows)) == (
        "E-COST: memory grows faster than the batch: 8503688 bytes for 1031 rows, 134217728 for 4096"
    )
    # What is small, or the same whatever the batch is, may be as it likes.
    assert message("cost", trial(peak=lambda rows: 1_000_000 if rows == ROWS else 0)) == ""
    assert message("cost", trial(peak=lambda rows: 500_000_000)) == ""


@pytest.mark.parametrize(("seconds", "slow"), [((1.5, 1.25), "1.2"), ((0.9, 5.0), ""), ((5.0, 0.9), "")])
@pytest.mark.parametrize(("name", "rows"), [("runs", 256), ("cost", 4096)])
def test_cost_in_time(monkeypatch, name, rows, seconds, slow):
    # Once may be bad luck; the clock is one of ours.
    clock = iter([0.0, seconds[0], 10.0, 10.0 + seconds[1]])
    monkeypatch.setattr(checks.time, "perf_counter", lambda: next(clock))
    said = message(name, trial())
    assert said == (f"E-COST: {rows} rows take {slow} s; at most 1 s are accepted" if slow else "")


def test_what_is_slow_is_not_tried_any_further(monkeypatch):
    clock = iter([0.0, 2.0, 2.0, 4.0])
    monkeypatch.setattr(checks.time, "perf_counter", lambda: next(clock))
    assert [check.name for check in examine(trial())] == ["runs"]


def test_empty_batch():
    assert message("empty batch", trial(lambda o, a: [a - a.max()])) == (
        "E-EMPTY: a batch without rows: E-RUN line 7: ValueError: "
        "zero-size array to reduction operation maximum which has no identity"
    )
    assert message("empty batch", trial(lambda o, a: [a if len(a) else np.zeros((1, 1))])) == (
        "E-EMPTY: a batch without rows: E-FORM: "
        "factor 1 must be an array of shape (batch_size, 1) = (0, 1), but is an array of shape (1, 1) and type float64"
    )


# --- all of them together --------------------------------------------------------------------------------------------


def test_a_sound_function_passes_them_all_in_this_order():
    names = "runs, form, control flow, loops, finite, deterministic, rows apart, batch sizes, cost, empty batch"
    assert list(examine(trial())) == [Check(name, True, "") for name in names.split(", ")]


def test_all_errors_come_at_once():
    found = list(examine(trial(lambda o, a: [a - a.max()], oblivious=raising("Looked"), steps=lambda rows: rows)))
    assert [check.name for check in found if not check.passed] == [
        *("control flow", "loops", "rows apart", "batch sizes", "empty batch"),
    ]
    assert len(found) == len(CHECKS)


@pytest.mark.parametrize(
    ("function", "last"),
    [
        (failing("no idea"), "runs"),
        (lambda o, a: [a[:, 0]], "form"),
        (lambda o, a: [np.log(a)], "finite"),
    ],
)
def test_without_factors_there_is_nothing_to_judge_further(function, last):
    found = list(examine(trial(function, steps=lambda rows: rows)))
    assert (found[-1].name, found[-1].passed) == (last, False)
    assert len(found) == list(CHECKS).index(last) + 1


def test_what_is_tried_is_always_the_same():
    one, other = trial(), trial()
    for first, second in zip(one.noise(50), other.noise(50), strict=True):
        np.testing.assert_array_equal(first, second)
    steps = one.steps(2 * STEPS + 1)
    np.testing.assert_array_equal(steps[0], [*one.observation, *one.observation, one.observation[0]])


# --- advice ----------------------------------------------------------------------------------------------------------


def columns(**factors) -> tuple[np.ndarray, list[str]]:
    return np.stack(list(factors.values()), axis=1), list(factors)


def test_advice():
    x = np.linspace(0, 1, 100)
    assert advice(*columns(near=x, still=np.full(100, 3.0), twice=-2 * x + 1, other=np.sin(9 * x))) == [
        "factor 'still' never varies on the recorded steps",
        "factor 'twice' repeats 'near' on the recorded steps",
    ]
    assert advice(*columns(a=np.zeros(100), b=np.zeros(100))) == [
        "factor 'a' never varies on the recorded steps",
        "factor 'b' never varies on the recorded steps",
    ]
    # Much alike is not the same, and a little is not nothing.
    assert advice(*columns(near=x, curved=x**1.5, faint=1 + 1e-6 * np.sin(9 * x))) == []


# --- in a worker -----------------------------------------------------------------------------------------------------

CASES = json.loads(Path(__file__).parents[1].joinpath("cases.json").read_text(encoding="utf-8"))
BENIGN = {case["name"]: case["code"] for case in CASES["benign"]}
HOSTILE = {case["name"]: case["code"] for case in CASES["hostile"] if case["gate"] != "static"}

FLOW = "a decision depends on values of the batch: use np.where instead of if, and, or, max, min"
FORM = "factor 1 must be an array of shape (batch_size, 1) = (256, 1), but is"
READ_ONLY = "is read-only (the inputs cannot be written into: copy them first)"
FIRST_MESSAGE = {
    "range_1e12": "E-RUN line 2: TooLarge: a sequence of 1000000000000 entries",
    "y_combinator": "E-CALL line 2: g is a value, and cannot be called",
    "int_power_variable": "E-RUN line 4: TooLarge: a power of integers",
    "np_zeros_1e12": (
        "E-RUN line 3: MemoryError: "
        "Unable to allocate 7.28 TiB for an array with shape (1000000, 1000000) and data type float64"
    ),
    "batch_max_scale": f"E-ROWS line 4: this goes over the batch: {ALONG}",
    "forgot_axis": f"E-ROWS line 4: this goes over the batch: {ALONG}",
    "neighbour_roll": f"E-ROWS line 3: numbers of two rows meet: {ALONG}",
    "cumsum_batch": f"E-ROWS line 3: this goes over the batch: {ALONG}",
    "batch_size_value": "E-BATCH: a step has other factors in a batch of 1 than in one of 256",
    "branch_on_first_row": f"E-FLOW line 2: {FLOW}",
    "branch_on_any": f"E-FLOW line 3: {FLOW}",
    "nan_division": (
        "E-FINITE line 2: factor 1 is nan for 256 of 256 steps of nothing but zeros (invalid value encountered in divide)"
    ),
    "nan_log_negative": (
        "E-FINITE line 3: factor 1 is nan for 129 of 256 recorded steps (invalid value encountered in log)"
    ),
    "inf_exp": "E-FINITE line 3: factor 1 is inf for 48 of 256 recorded steps (overflow encountered in exp)",
    "shape_1d": f"E-FORM: {FORM} an array of shape (256,) and type float32{ONE_DIMENSION}",
    "shape_row": f"E-FORM: {FORM} an array of shape (1, 256) and type float32",
    "returns_array": (
        "E-FORM: evaluation_func must return a list of arrays, but returned an array of shape (256, 1) and type float32"
    ),
    "returns_scalar": f"E-FORM: {FORM} a float",
    "returns_empty": "E-FORM: evaluation_func must return 1 to 32 factors, but returned 0",
    "factor_count_varies": (
        "E-FORM: the number of factors depends on the batch: "
        "3 for 256 rows, 3 for 64 rows, 1 for 1 rows, 3 for 1031 rows"
    ),
    "dtype_complex": (
        "E-FINITE line 3: factor 1 is nan for 256 of 256 recorded steps (invalid value encountered in sqrt)"
    ),
    "slice_hallucinated_dim": (
        f"E-FORM: {FORM} an array of shape (256, 0) and type float32: a slice beyond the last column is empty"
    ),
    "row_loop_slow": "E-LOOP: it makes 65 turns for 64 rows and 1032 for 1031: no loop over the batch, use whole arrays",
    "mutate_alias": f"E-RUN line 3: ValueError: assignment destination {READ_ONLY}",
    "augassign_alias": f"E-RUN line 3: ValueError: output array {READ_ONLY}",
    "positional_out": "E-CALL line 3: np.add takes 2 arguments by position, not 3",
    "all_rows_done_flag": f"E-FLOW line 3: {FLOW}",
}  # fmt: skip


class Watched:
    """A worker, and the audit events of all its calls."""

    def __init__(self, source: str, **options):
        self.program = JailedProgram(source, 17, 6, **options)
        self.events: set[str] = set()

    def call(self, *arguments):
        returned = self.program.call(*arguments)
        self.events |= {*returned.events}
        return returned


def trial_in_a_worker(watched: Watched) -> Trial:
    # One worker for both roles: that another one gives the same is a test of its own, and half of the time.
    random = np.random.default_rng(7)
    observation, action = random.standard_normal((STEPS, 17)), random.uniform(-1, 1, (STEPS, 6))
    return Trial(watched, watched, observation.astype(np.float32), action.astype(np.float32))


def test_every_hostile_program_has_its_message():
    assert FIRST_MESSAGE.keys() == HOSTILE.keys()


@pytest.mark.parametrize("name", HOSTILE)
def test_the_hostile_programs_are_refused(seccomp, name):
    watched = Watched(HOSTILE[name])
    found = [str(problem) for problem in watched.program.problems]
    if not found:
        found = [check.message for check in examine(trial_in_a_worker(watched)) if not check.passed]
    watched.program.close()
    assert found[0] == FIRST_MESSAGE[name]


@pytest.mark.parametrize("name", BENIGN)
def test_the_benign_programs_pass_and_ask_the_system_for_nothing(seccomp, name):
    # A call that the filter refuses would kill the worker.
    watched = Watched(BENIGN[name], kill=True, audit=True)
    found = list(examine(trial_in_a_worker(watched)))
    watched.program.close()
    assert [check.message for check in found if not check.passed] == []
    assert len(found) == len(CHECKS)
    assert watched.events == set()


@pytest.mark.parametrize(
    ("error", "said", "unproved"),
    [
        (None, "", ""),
        ("Mixed: numbers of two rows meet", f"E-ROWS line 7: numbers of two rows meet: {ALONG}", ""),
        ("Unproved: np.outer", "", "np.outer in line 7"),
        ("TypeError: who knows", "", "who knows in line 7"),
    ],
)
def test_rows_are_proved_apart_where_that_can_be(error, said, unproved):
    one = trial()
    call = one.program.call

    def in_rows(observation, action, mode="plain"):
        returned = call(observation, action, mode)
        return dataclasses.replace(returned, error=error, line=7 if error else None) if mode == "rows" else returned

    one.program.call = in_rows
    assert message("rows apart", one) == said
    assert one.unproved == unproved
    sizes = [rows for rows, _, mode in one.program.asked if mode == "rows"]
    assert sizes == (list(SIZES[1:]) if error is None else [2])
