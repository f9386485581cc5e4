"""Arrays that know which row each number depends on: what rows meet is found, whatever the values are."""

import json
from pathlib import Path

import numpy as np
import pytest

from lare.latent.language import allowed
from lare.latent.language.program import Program
from lare.latent.verification.rows import (
    FUNCTIONS,
    NONE,
    Mixed,
    Rowed,
    Unproved,
    check_own,
    labelled,
    of_rows,
    plain,
    rows_of,
)
from toys import PHI, phi

CASES = json.loads(Path(__file__).parents[1].joinpath("cases.json").read_text(encoding="utf-8"))
BENIGN = {case["name"]: case["code"] for case in CASES["benign"]} | {"toy": PHI}


def batch(rows: int = 8) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(5)
    observation, action = random.standard_normal((rows, 17)), random.uniform(-1, 1, (rows, 6))
    return observation.astype(np.float32), action.astype(np.float32)


def prove(body: str, rows: int = 8):
    """Runs some lines on such arrays. Raises where rows meet, or nobody can tell."""
    values = Program(phi(body), FUNCTIONS)(*map(labelled, batch(rows)))
    check_own(values, rows)
    return values


@pytest.mark.parametrize("rows", [2, 8, 64])
@pytest.mark.parametrize("name", BENIGN)
def test_benign_programs_are_proved_and_compute_the_same(name, rows):
    with np.errstate(all="ignore"):
        found = Program(BENIGN[name], FUNCTIONS)(*map(labelled, batch(rows)))
        expected = Program(BENIGN[name])(*batch(rows))
    check_own(found, rows)
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(plain(ours), theirs)


JOIN, MEET = "this goes over the batch", "numbers of two rows meet"
PLACE = "a constant has another value for each row"


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("return [action[:, :1] - action.mean()]", JOIN),
        ("return [action[:, :1] - action.mean(axis=0)[:1]]", JOIN),
        ("return [action[:, :1] / np.linalg.norm(action)]", JOIN),
        ("return [np.cumsum(action, axis=0)[:, :1]]", JOIN),
        ("return [np.sort(action, axis=0)[:, :1]]", JOIN),
        ("return [np.diff(action, axis=0, prepend=0)[:, :1]]", JOIN),
        ("return [(action @ action.T)[:, :1]]", MEET),
        ("return [np.einsum('ij,kj->i', action, action)[:, None]]", JOIN),
        ("return [np.einsum('ij,ij->j', action, action)[:1] + action[:, :1]]", JOIN),
        ("return [np.einsum('ij,ij->i', action, action[::-1])[:, None]]", MEET),
        ("return [np.roll(action[:, :1], 1, axis=0)]", "factor 1 of a row is that of another"),
        ("return [action[::-1, :1]]", "factor 1 of a row is that of another"),
        ("return [action[[0] * len(action), :1]]", "factor 1 of a row is that of another"),
        ("return [np.tile(action[:1, :1], (len(action), 1))]", "factor 1 of a row is that of another"),
        ("return [action[:, :1] + action[0, 0]]", MEET),
        ("x = np.zeros_like(action)\nx[1:] = action[:-1]\nreturn [action[:, :1] + x[:, :1]]", MEET),
        ("x = np.zeros_like(action)\ny = x[:, 0]\ny[1:] = action[:-1, 0]\nreturn [action[:, :1] + x[:, :1]]", MEET),
        ("x = np.zeros(1)\nx[:] = action[0, 0]\nreturn [action[:, :1] + x]", MEET),
        ("x = np.zeros_like(action)\nnp.add(action[::-1], 1, out=x)\nreturn [action[:, :1] + x[:, :1]]", MEET),
        ("x = action.astype(float)\nx -= x[:1]\nreturn [x[:, :1]]", MEET),
        ("return [action[:, :1] * (action[:, 0] > 0)]", MEET),
        ("return [np.where(action[:, :1] > 1e30, action.max(), action[:, :1])]", JOIN),  # however rare it is
        ("return [1e9 + 1e-9 * action[:, :1] * action.sum()]", JOIN),  # however little it is
        ("i = np.arange(len(action)) + (action[:, 0] > 1e30)\nreturn [action[i, 0][:, None]]", PLACE),
        ("return [np.take_along_axis(action, np.argmin(action, axis=1)[:, None], axis=0)[:, :1]]", JOIN),
        ("return [action[:, :1] * np.arange(len(action))[:, None]]", PLACE),
        ("return [np.where(action[:, :1] > 1e30, np.arange(len(action))[:, None], 0)]", PLACE),
        ("return [np.arange(len(action))[:, None] * 1.0]", "factor 1 has another value for each place in the batch"),
        ("return [action[:, :1], np.concatenate([action[:1, :1], np.zeros((len(action) - 1, 1))])]",
         "factor 2 has another value for each place in the batch"),
    ],
)  # fmt: skip
def test_rows_that_meet(body, message):
    with pytest.raises(Mixed) as error:
        prove(body)
    assert str(error.value) == message


@pytest.mark.parametrize(
    "body",
    [
        "return [np.stack([action[:, 0], action[:, 1]], axis=1).sum(axis=1, keepdims=True)]",
        "return [np.einsum('ij,ij->i', action, action)[:, None], np.einsum('ij,kj->ik', action, np.ones((3, 6)))[:, :1]]",
        "x = np.zeros((len(action), 2))\nx[:, 0] = action[:, 0]\nx[:, 1:2] += action[:, :1]\nreturn [x[:, 1:]]",
        "x = action.T\nreturn [x.sum(axis=0)[:, None], x[0].reshape(-1, 1)]",
        "rows = np.arange(len(action))\nreturn [action[rows, np.argmax(action, axis=1)][:, None]]",
        "return [np.take_along_axis(action, np.argmin(action, axis=1)[:, None], axis=1)]",
        "x = observation.reshape(len(observation), -1, 1) - action[:, None, :]\nreturn [np.abs(x).min(axis=(1, 2))[:, None]]",
        "return [np.select([action[:, :1] > 0.5, action[:, :1] < 0], [action[:, :1], action[:, 1:2]], default=0.0)]",
        "x = np.divide(action[:, :1], action[:, 1:2], out=np.zeros_like(action[:, :1]), where=action[:, 1:2] > 0.1)\nreturn [x]",
        "return [np.percentile(action, 25, axis=1, keepdims=True), np.median(action, axis=1)[:, None]]",
        "return [np.full((len(action), 1), 2.0), np.ones_like(action[:, :1])]",
        "q = action / np.linalg.norm(action, axis=1, keepdims=True)\nreturn [(q @ np.eye(6))[:, :1], q.dot(np.ones(6))[:, None]]",
        "return [np.interp(action[:, 0], [0, 1], [0, 1])[:, None], np.nan_to_num(action[:, :1]), action[:, :1].round(2)]",
    ],
)
@pytest.mark.parametrize("rows", [2, 8])
def test_rows_that_do_not_meet(body, rows):
    assert all(type(value) is Rowed for value in prove(body, rows))


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("return [np.outer(action[:, 0], np.ones(1))]", "np.outer"),
        ("if action[0, 0] > 2: pass\nreturn [action[:, :1]]", "a value is looked into"),
        ("return [action[action[:, 0] > -9, :1]]", "an index by values, beside new axes or masks"),
        ("return [np.interp(action[:, 0], [0, 1], action[0, :2])[:, None]]", "np.interp by values"),
        ("return [np.repeat(action[:, :1], np.argmax(action, axis=1) * 0 + 1, axis=0)]", "a place by values"),
    ],
)
def test_what_nobody_can_tell(body, message):
    with pytest.raises(Unproved) as error:
        prove(body)
    assert str(error.value) == message


ARGUMENTS = {
    **dict.fromkeys("stack hstack vstack dstack column_stack concatenate".split(), lambda x: ([x, x + 1],)),
    **dict.fromkeys("zeros ones arange eye identity".split(), lambda x: (3,)),
    **dict.fromkeys("repeat roll tile full_like".split(), lambda x: (x, 2)),
    **dict.fromkeys("percentile quantile".split(), lambda x: (x, 0.5, 1)),
    **dict.fromkeys("sum prod mean max min amax amin all any nanmax nanmean nanmin nansum std var".split(), lambda x: (x, 1)),
    **dict.fromkeys("median ptp average argmax argmin cumsum cumprod sort".split(), lambda x: (x, 1)),
    **{f"{name}.reduce": lambda x: (x, 1) for name in "add multiply maximum minimum logical_and logical_or".split()},
    "broadcast_to": lambda x: (x, (2, 8, 3)),
    "diff": lambda x: (x, 1, 1),
    "dot": lambda x: (x, np.ones((3, 2))),
    "einsum": lambda x: ("ij,kj->ki", x, np.ones((2, 3))),
    "expand_dims": lambda x: (x, 1),
    "finfo": lambda x: (np.float32,),
    "full": lambda x: ((8, 3), x),
    "interp": lambda x: (x, [0.0, 1.0], [0.0, 2.0]),
    "invert": lambda x: (x > 0,),
    "linalg.norm": lambda x: (x, 2, 1),
    "linspace": lambda x: (0, 1),
    "matmul": lambda x: (np.ones((2, 3)), x.T),
    "moveaxis": lambda x: (x, 0, 1),
    "reshape": lambda x: (x, (4, 6)),
    "select": lambda x: ([x > 1], [x]),
    "split": lambda x: (x, 2),
    "swapaxes": lambda x: (x, 0, 1),
    "take": lambda x: (x, [1, 0]),
    "take_along_axis": lambda x: (x, np.zeros((8, 1), int), 1),
    "where": lambda x: (x > 1, x, 1),
    "clip": lambda x: (x, 0.1, 1),
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(name for name in allowed.NUMPY if name not in ("shape", "ndim", "size")))
def test_what_changes_with_a_row_is_of_that_row(name):
    values = np.abs(batch()[0][:, :3]).astype(float) + 0.5
    of = ARGUMENTS.get(name, lambda x: (x,) * allowed.NUMPY[name].least)
    function = FUNCTIONS[f"numpy.{name}()" if name in allowed.DTYPES else f"numpy.{name}"]
    with np.errstate(all="ignore"):
        try:
            found = function(*of(labelled(values)))
        except (Unproved, Mixed):
            return  # which is safe
        for row in range(8):
            other = values.copy()
            other[row] *= 1.7
            again = function(*of(labelled(other)))
            pairs = zip(found, again, strict=True) if isinstance(found, list) else [(found, again)]
            for one, changed in pairs if name != "finfo" else ():
                ours, theirs = plain(one), plain(changed)
                differs = (ours != theirs) & ((ours == ours) | (theirs == theirs))  # NaN stays NaN
                assert (rows_of(one)[differs] == row).all()


def test_arrays_and_their_rows_see_the_same_memory():
    x = labelled(batch()[0].copy())
    view, copied, made = x[:, 1:3], x.copy(), np.asarray(plain(x))
    view[...] = 0
    assert not of_rows(x[:, 1:3])
    assert of_rows(copied[:, 1:3])
    assert (rows_of(made) == NONE).all()
    y = FUNCTIONS["numpy.asarray"](x, np.float64)
    y[...] = 0
    assert of_rows(x)
    z = FUNCTIONS["numpy.reshape"](FUNCTIONS["numpy.zeros"]((8, 2)), (4, 4))
    z[0] = x[0, 0]
    assert of_rows(z)
