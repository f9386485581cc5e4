"""Arrays that refuse to be looked into: who looks is found, with the line, and who does not gets the same numbers."""

import json
import traceback
from pathlib import Path

import numpy as np
import pytest

from lare.latent.language import allowed
from lare.latent.language.program import FILE, Program
from lare.latent.verification.oblivious import (
    Looked,
    Missing,
    Oblivious,
    Watched,
    careful_functions,
    hidden,
    owner,
    shown,
    watched,
)
from toys import PHI, phi

CASES = json.loads(Path(__file__).parents[1].joinpath("cases.json").read_text(encoding="utf-8"))
BENIGN = {case["name"]: case["code"] for case in CASES["benign"]} | {"toy": PHI}
FUNCTIONS = careful_functions()


def batch() -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(5)
    observation, action = random.standard_normal((8, 17)), random.uniform(-1, 1, (8, 6))
    return observation.astype(np.float32), action.astype(np.float32)


def run_hidden(source: str):
    return Program(source, FUNCTIONS)(*hidden(batch()))


DECISION = "a decision depends on values of the batch: use np.where instead of if, and, or, max, min"
NUMBER = "a value of the batch is turned into one number: keep it an array"
NO_MATH = f"{NUMBER}, and use np instead of math"
LIST_INDEX = "a value of the batch is used as an index: use np.where or np.take_along_axis"
SHAPE = "the shape of an array depends on values of the batch: use np.where, which keeps every row"
INDEX = "an array is indexed by values of the batch: use np.where or np.take_along_axis"


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        ("1 if x[0, 0] > 0 else 2", DECISION),
        ("1 if x[0, 0] else 2", DECISION),
        ("1 if np.any(x > 0) else 2", DECISION),
        ("1 if np.sum(x) > 0 and True else 2", DECISION),
        ("1 if (x > 0).all() else 2", DECISION),
        ("1 if x.mean() > x.std() else 2", DECISION),
        ("1 if np.linalg.norm(x) > 1 else 2", DECISION),
        ("1 if np.median(x) > 1 else 2", DECISION),
        ("1 if np.isclose(x[0, 0], 1) else 2", DECISION),
        ("1 if np.array([1.0, x[0, 0]]).max() > 1 else 2", DECISION),
        ("1 if np.concatenate([np.zeros(3), x[0]])[0] else 2", DECISION),
        ("1 if np.full((8, 1), x[0, 0])[0, 0] else 2", DECISION),
        ("1 if np.where(np.ones(8) > 0, x[:, 0], 1)[0] else 2", DECISION),
        ("1 if x[0] @ x[0] > 1 else 2", DECISION),
        ("1 if (x[0, 0] + 1) ** 2 * 3 % 2 // 1 > 0 else 2", DECISION),
        ("1 if abs(-x[0, 0]) > 1 else 2", DECISION),
        ("1 if x.copy().T.reshape(-1).astype(float)[0] > 1 else 2", DECISION),
        ("1 if 0 < x[0, 0] < 1 else 2", DECISION),
        ("1 if 0.5 in x[:, 0] else 2", DECISION),
        ("1 if x[0, 0] in [0.5] else 2", DECISION),
        ("1 if [x[0, 0]] == [0.5] else 2", DECISION),
        ("1 if (x[0, 0],) < (0.5,) else 2", DECISION),
        ("not x[0, 0]", DECISION),
        ("x[0, 0] or 1", DECISION),
        ("max(x[0, 0], 0.0)", DECISION),
        ("min(x[0])", DECISION),
        ("sorted(x[0])[0]", DECISION),
        ("any(x[0] > 0)", DECISION),
        ("all([x[0, 0] > 0, True])", DECISION),
        ("bool(x[0, 0])", DECISION),
        ("[v for v in x[0] if v > 0][0]", DECISION),
        ("[k for k in range(3) if x[0, k] > 0][0]", DECISION),
        ("1 if [w for w, v in zip(x[0], x[1])][0] else 2", DECISION),
        ("1 if [v for k, v in enumerate(x[0])][0] else 2", DECISION),
        ("1 if list(x[0])[0] else 2", DECISION),
        ("1 if {'a': x[0, 0]}['a'] else 2", DECISION),
        ("int(x[0, 0])", NUMBER),
        ("list(range(9))[x[0, 0].astype(int)]", LIST_INDEX),
        ("[1, 2][np.argmax(x[0])]", LIST_INDEX),
        ("[1, 2, 3][: x[0, 0].astype(int)]", LIST_INDEX),
        ("x[:, : x[0, 0].astype(int)]", LIST_INDEX),
        ("float(x[0, 0])", NO_MATH),
        ("math.sqrt(x[0, 0] ** 2)", NO_MATH),
        ("math.floor(x[0, 0])", NO_MATH),
        ("math.hypot(1, x[0, 0])", NO_MATH),
        ("x[x > 0]", INDEX),
        ("x[x[:, 0] > 0, 0]", INDEX),
        ("x[np.argmax(x, axis=1)]", INDEX),
        ("x[..., np.argmax(x[0])]", INDEX),
        *[
            (call, SHAPE)
            for call in (
                "np.zeros((1, 2)).sum(axis=k)",
                "np.zeros((1, 2)).sum(k)",
                "np.sum(np.zeros((1, 2)), k)",
                "np.add.reduce(np.zeros((1, 2)), k)",
                "np.max(x, keepdims=k)",
                "np.swapaxes(x, 0, k)",
                "np.zeros((1, 2)).swapaxes(0, k)",
                "np.moveaxis(x, k, 0)",
                "np.transpose(x, [k, 1])",
                "np.zeros((1, 2)).transpose(k, 1)",
                "np.expand_dims(x, k)",
                "np.zeros((1, 1)).squeeze(k)",
                "np.stack([x, x], axis=k)",
                "np.concatenate([x, x], k)",
                "np.diff(x, n=k)",
                "np.array([1.0], ndmin=k)",
                "np.tensordot(x, x, axes=k)",
                "np.linalg.norm(x, ord=k)",
                "np.quantile(x, 0.5, k)",
                "np.roll(x, k)",
                "np.take(x, 0, k)",
                "np.tril(x, k=k)",
            )
        ],
    ],
)
def test_who_looks_is_found(expression, message):
    with pytest.raises(Looked) as error:
        run_hidden(phi(f"x = observation\nk = (x.sum() > 1e20).astype(int)\nreturn [action * ({expression})]"))
    assert str(error.value) == message
    lines = [frame.lineno for frame in traceback.extract_tb(error.value.__traceback__) if frame.filename == FILE]
    assert lines[-1] == 4


@pytest.mark.parametrize(
    "written",
    [
        "x[:] = action",
        "x[:, 0] = action[:, 0]",
        "x[0] = [action[0, 0], 1, 2, 3, 4, 5]",
        "x[action > 0] = 1",
        "x[np.argmax(action[0])] = 1",
        "x[:] += action",
        "y = x\ny += action",
        "y = x\ny @= action[:6] + np.eye(6)",
        "y = [x]\ny[0] *= action",
        "x.T[:] = action.T",
        "x.reshape(-1)[:] = action.reshape(-1)",
        "np.swapaxes(x, 0, 1)[:] = action.T",
        "y = np.asarray(x)[1:]\ny[0] = action[0]",
        "for x[:, 0] in [action[:, 0]]: pass",
        "y = [0 for x[:] in [action]]",
        "x[:], y = action, 1",
        "np.add(action, 1, out=x)",
        "np.add(action[:, 0:3], 1, out=x[:, 0:3])",
        "np.add(1, 2, out=x, where=action > 0)",
        "def f(y): y[:] = action\nf(x)",
        "y = np.zeros((8, 6))\ny[:] = action\nx[:] = y",
    ],
)
@pytest.mark.parametrize(
    "look", ["x[0, 0]", "view[0, 0]", "x.sum()", "np.max(x + 1)", "x.copy()[0, 0]", "1 + abs(view.T)[0, 0]"]
)
def test_an_array_that_takes_values_in_is_hidden_with_all_its_views(written, look):
    with pytest.raises(Looked, match=DECISION):
        run_hidden(phi(f"x = np.zeros((8, 6))\nview = x[:, 0:2]\n{written}\nif {look} > 0: pass\nreturn [x]"))


@pytest.mark.parametrize(
    "body",
    [
        "x = np.zeros((8, 6))\nx[:] = 1\nx += 2\nnp.add(x, 1, out=x)\nif x[0, 0] == 4: return [action]",
        "x = np.zeros((8, 6))\ny = x.copy()\ny[:] = action\nif x[0, 0] == 0: return [action]",
        "x = np.zeros((8, 6))\ny = x[:, 0] + 0\nx[:] = action\nif y[0] == 0: return [action]",
    ],
)
def test_constants_that_values_do_not_reach_stay_open(body):
    assert type(run_hidden(phi(f"{body}\nreturn []"))[0]) is Oblivious


def test_a_table_of_constants_may_be_read_by_values_but_not_cut_by_them():
    table = "x = np.array([1.0, 2.0, 3.0])\nplaces = np.argmax(action, axis=1) % 3\n"
    assert type(run_hidden(phi(f"{table}return [x[places][:, None]]"))[0]) is Oblivious
    with pytest.raises(Looked, match=DECISION):
        run_hidden(phi(f"{table}if x[places][0] > 1: pass"))
    with pytest.raises(Looked, match=INDEX):
        run_hidden(phi(f"{table}return [x[places[0:3] > 0]]"))


@pytest.mark.parametrize(
    ("index", "slice"),
    [
        (":, 99:100", "99:100"),
        (":, 16:18", "16:18"),
        (":, :18", "None:18"),
        (":, -18:", "-18:None"),
        (":, 18:None", "18:None"),
        ("0:1, 20:", "20:None"),
    ],
)
def test_who_reads_what_is_not_there_is_found(index, slice):  # noqa: A002
    with pytest.raises(Missing) as error:
        run_hidden(phi(f"return [observation[{index}].sum(axis=1, keepdims=True)]"))
    assert str(error.value) == f"the slice {slice} reaches past the 17 entries that there are"


@pytest.mark.parametrize(
    "index", [":, 5:17", ":, -17:-1", ":, :", "99:", "-99:, 0:1", ":, None, 0:1", ":, 5", ":, 16:17:9"]
)
def test_who_reads_what_is_there_is_not(index):
    assert run_hidden(phi(f"return [observation[{index}]]"))


@pytest.mark.parametrize("source", BENIGN.values(), ids=BENIGN)
def test_who_does_not_look_gets_the_same_numbers(source):
    factors = run_hidden(source)
    for factor, plain in zip(factors, Program(source)(*batch()), strict=True):
        np.testing.assert_array_equal(shown(factor), plain)
        assert factor.dtype == plain.dtype


@pytest.mark.parametrize(
    "body",
    [
        "if observation.shape[0] > 3 and observation.ndim == 2: pass",
        "if len(action) == action.shape[0] and np.shape(action)[1] > 2 and np.size(action, 1): pass",
        "if action.dtype == np.float32: pass",
        "if np.finfo(action.dtype).eps < 1: pass",
        "for column in range(action.shape[1]): pass",
        "if np.zeros(3)[0] == 0 and np.arange(3).max() > 1 and float(np.sum(np.ones(3))) > 2: pass",
        "weights = np.array([1.0, 2.0])\nif weights[weights > 1][0] > 1: pass",
        "if action is None: pass",
    ],
)
def test_to_look_at_shapes_and_constants_is_no_harm(body):
    assert type(run_hidden(phi(f"{body}\nreturn [action]"))[0]) is Oblivious


ARGUMENTS = {
    "numpy.array": lambda x: ([x[0], x[1]],),
    "numpy.average": lambda x: (x, 1, x),
    "numpy.broadcast_to": lambda x: (x, (2, 8, 3)),
    "numpy.concatenate": lambda x: ([np.zeros((1, 3)), x],),
    "numpy.cross": lambda x: (x, x),
    "numpy.einsum": lambda x: ("ij,ij->i", x, x),
    "numpy.expand_dims": lambda x: (x, 0),
    "numpy.full": lambda x: ((2, 2), x[0, 0]),
    "numpy.full_like": lambda x: (np.zeros(3), x[0]),
    "numpy.interp": lambda x: (x[:, 0], [0, 1], [0, 1]),
    "numpy.inner": lambda x: (x[0], x[0]),
    "numpy.invert": lambda x: (x > 0,),
    "numpy.linalg.det": lambda x: (x[:3],),
    "numpy.linspace": lambda x: (x[0], x[1]),
    "numpy.moveaxis": lambda x: (x, 0, 1),
    "numpy.dot": lambda x: (x[0], x[0]),
    **{f"numpy.{name}()": (lambda x: (x,)) for name in allowed.DTYPES},
    "numpy.matmul": lambda x: (x[0], x[0]),
    "numpy.ones_like": lambda x: (x,),
    "numpy.pad": lambda x: (x, 1),
    "numpy.percentile": lambda x: (x, 50),
    "numpy.quantile": lambda x: (x, 0.5),
    "numpy.repeat": lambda x: (x, 2),
    "numpy.reshape": lambda x: (x, -1),
    "numpy.roll": lambda x: (x, 1),
    "numpy.select": lambda x: ([x > 0], [x]),
    "numpy.split": lambda x: (x, 2),
    "numpy.swapaxes": lambda x: (x, 0, 1),
    "numpy.squeeze": lambda x: (x,),
    "numpy.take": lambda x: (x, [0, 1]),
    "numpy.take_along_axis": lambda x: (x, np.zeros((8, 1), int), 1),
    "numpy.tensordot": lambda x: (x, x.T, 1),
    "numpy.tile": lambda x: (x, 2),
    "numpy.vdot": lambda x: (x, x),
    "numpy.where": lambda x: (x > 0, x, 1),
    "numpy.zeros_like": lambda x: (x,),
    "numpy.clip": lambda x: (x, 0, 1),
    **{f"numpy.{name}": (lambda x: ([x, x],)) for name in ("stack", "hstack", "vstack", "dstack", "column_stack")},
}
"""For what cannot simply be called with one array or two."""
TAKE_NO_ARRAY = {"numpy.finfo", "numpy.arange", "numpy.eye", "numpy.identity", "numpy.ones", "numpy.zeros"}


@pytest.mark.parametrize("name", sorted(name for name in FUNCTIONS.keys() - TAKE_NO_ARRAY if not name.startswith("$")))
def test_no_function_of_numpy_forgets_whom_it_was_given(name):
    x = np.abs(batch()[0][:, :3]) + 0.5
    if name in ARGUMENTS:
        given, plain = ARGUMENTS[name](hidden(x)), ARGUMENTS[name](x)
    else:
        given, plain = ((one,) * allowed.DOTTED[name].least for one in (hidden(x), x))
    with np.errstate(all="ignore"):
        found, expected = FUNCTIONS[name](*given), FUNCTIONS[name](*plain)
    several = isinstance(found, list | tuple)
    for one, other in zip(found if several else [found], expected if several else [expected], strict=True):
        assert type(one) is Oblivious
        np.testing.assert_array_equal(shown(one), other)


def test_functions_of_what_is_not_hidden_hide_nothing():
    assert type(FUNCTIONS["numpy.sum"](np.ones(3))) is Watched
    assert type(FUNCTIONS["numpy.zeros"]((2, 3))) is Watched
    assert float(FUNCTIONS["numpy.zeros"]((2, 3))[0, 0]) == 0


@pytest.mark.parametrize("name", sorted(name for name in FUNCTIONS.keys() - TAKE_NO_ARRAY if not name.startswith("$")))
def test_who_shares_memory_has_its_owner(name):
    x = watched(np.abs(batch()[0][:, :3]) + 0.5)
    given = ARGUMENTS[name](x) if name in ARGUMENTS else (x,) * allowed.DOTTED[name].least
    with np.errstate(all="ignore"):
        found = FUNCTIONS[name](*given)
    for one in found if isinstance(found, list | tuple) else [found]:
        assert not np.shares_memory(one, x) or owner(one) is owner(x)


def test_a_keyword_is_an_argument_too():
    x = hidden(np.ones((2, 3)))
    assert type(FUNCTIONS["numpy.sum"](np.ones((2, 3)), where=x > 0)) is Oblivious
    assert type(FUNCTIONS["numpy.full"]((2, 3), fill_value=x[0, 0])) is Oblivious


METHODS = {
    **dict.fromkeys(
        "sum prod mean max min all any std var cumsum cumprod flatten ravel squeeze transpose copy".split(), ()
    ),
    "astype": ("f8",),
    "clip": (0, 1),
    "repeat": (2,),
    "reshape": (-1,),
    "swapaxes": (0, 1),
}


@pytest.mark.parametrize("name", METHODS)
def test_no_method_forgets_whom_it_belongs_to(name):
    assert type(getattr(hidden(batch()[0]), name)(*METHODS[name])) is Oblivious


@pytest.mark.parametrize("name", ["T", "shape", "dtype", "ndim", "size"])
def test_attributes(name):
    value = getattr(hidden(batch()[0]), name)
    assert (type(value) is Oblivious) == (name == "T")


def test_hidden_and_shown_again():
    x, (y, z) = hidden((np.ones(3), [np.float32(2), "text"]))
    assert [type(one) for one in (x, y, z)] == [Oblivious, Oblivious, str]
    assert [type(one) for one in shown([x, (y, z)])] == [np.ndarray, tuple]


def test_an_entry_of_each_row_may_be_chosen_by_its_values():
    own = "rows = np.arange(len(observation))\nnearest = np.argmin(observation, axis=1)\n"
    (found,) = run_hidden(phi(f"{own}return [observation[rows, nearest][:, None]]"))
    assert type(found) is Oblivious
    with pytest.raises(Looked, match=INDEX):
        run_hidden(phi(f"{own}return [observation[nearest]]"))


MADE = "z[:] = np.max(observation[:, 8:9], axis=0, initial=0.0)\nif z[0] > 1e5: return [action]\nreturn [-action]"
SHED = {
    "a scalar that is reshaped": "z = np.float64(0.0).reshape(1)",
    "repeated": "z = np.float64(0.0).repeat(1)",
    "with an axis more": "z = np.float64(0.0)[None]",
    "with an ellipsis": "z = np.float64(0.0)[..., np.newaxis]",
    "of a machine": "z = np.finfo(np.float64).eps.reshape(1)",
    "of a machine, with an axis more": "z = np.finfo(np.float64).max[None]",
    "of a sum": "z = np.sum([0.0, 1.0]).reshape(1)",
    "of an entry": "z = np.zeros(3)[0].reshape(1)",
    "gone through": "for x in np.zeros(3): z = x.reshape(1)",
    "taken apart": "x, y = np.zeros(2)\nz = x.reshape(1)",
    "of an operator": "z = (np.float64(0.0) + 1.0).reshape(1)",
    "of the largest": "z = max(np.zeros(3)).reshape(1)",
    "of Python's sum": "z = sum(np.zeros(3)).reshape(1)",
    "transposed": "z = np.float64(0.0).T.reshape(1)",
    "copied": "z = np.float64(0.0).copy().flatten()",
    "of a list": "z = [x.ravel() for x in np.zeros(2)][0]",
}


@pytest.mark.parametrize("made", SHED.values(), ids=SHED)
def test_no_array_sheds_its_watcher(made):
    with pytest.raises(Looked, match="a decision depends on values of the batch"):
        run_hidden(phi(f"{made}\n{MADE}"))


def test_what_numbers_can_do_constants_can():
    lines = [
        "x = np.mean([1.0, 2.5])",
        "y = round(x, 1) + round(np.float64(2.6)) + abs(-x) + int(x) + float(x) + math.sqrt(x)",
        "for i in np.arange(3): y += [1, 2, 3][i] * {0: 1, 1: 2, 2: 3}[i]",
        "if x > 1 and bool(np.any([False, True])) and np.finfo(np.float32).eps < 1: y += max(x, 1) + range(3)[np.int64(1)]",
        "return [action[:, :1] * y * np.finfo(action.dtype).tiny]",
    ]
    source = "import math\n" + phi("\n".join(lines))
    (found,), (expected,) = run_hidden(source), Program(source)(*batch())
    np.testing.assert_array_equal(shown(found), expected)
