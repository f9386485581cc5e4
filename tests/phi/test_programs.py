"""Every trusted program is read. Its graph gives the numbers of Python and NumPy, row by row, in NumPy and in JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.long_tests import long_case
from helpers.phi_programs import (
    benign_programs,
    execute_program,
    random_inputs,
    read_program,
    recorded_programs,
    repaired_programs,
    varied_programs,
)
from helpers.toy_envs import phi_source
from lare_rl.phi.evaluate import evaluate
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.read import read

REFUSED = {
    "a_covariance_logdet": "eigenvalues of 4 x 4 matrices",
    "b_chess_material": "an array of texts",
    "c_traffic_lights_grid": "np.ma",
    **dict.fromkeys(
        "c_crane_sway_loops c_nbody_tugboats c_heat_exchanger_march c_truss_robot_welder c_reservoir_cascade "
        "c_satellites_debris_avoid c_greenhouse_beginner c_hospital_beds_beginner".split(),
        "a loop over the rows",
    ),
    **dict.fromkeys(
        (f"factors/Snake-v1.draw0/{reply}" for reply in (*(f"candidate{k}" for k in range(5)), "combine0")),
        "arrays of which a test or a sum goes over the rows",
    ),
}
"""Programs that are refused, and why."""
ALL_PROGRAMS = {p.name: p for p in (*benign_programs(), *varied_programs(), *recorded_programs())}
PROGRAMS = {name: program for name, program in ALL_PROGRAMS.items() if name not in REFUSED}
SHORT = {p.name for p in (*benign_programs(), *varied_programs()[::4], *recorded_programs()[::48])} & set(PROGRAMS)
SINGLE = ("float32", "single", "float16")
"""Programs with these words compute in single precision here and there. Graphs do not follow that."""


def check_equal(result, expected, tolerance):
    with np.errstate(invalid="ignore"):
        close = np.abs(result - expected) <= tolerance * (1 + np.abs(expected))
    same = close | (np.isnan(result) & np.isnan(expected)) | (result == expected)
    assert same.all(), (result[~same][:3], expected[~same][:3])


def make_inputs(program, **kwargs):
    return dict(zip(("observation", "action"), random_inputs(program.sizes, **kwargs), strict=True))


@pytest.mark.parametrize("name", [name if name in SHORT else long_case(name) for name in PROGRAMS])
def test_program_agrees_with_numpy(name):
    program = PROGRAMS[name]
    graph, inputs = read_program(program), make_inputs(program, dtype=np.float32)
    # A third of the rows each: as they are, ten times as large, and zeros.
    scales = np.repeat(np.array([1, 10, 0], np.float32), 16)[:, None]
    inputs = {key: (array * scales).astype(np.float64) for key, array in inputs.items()}
    exact = evaluate(graph, inputs, dtype=np.float64)["factors"]
    expected = execute_program(program.source, **inputs)
    check_equal(exact, expected, 1e-6 if any(word in program.source for word in SINGLE) else 1e-9)


@pytest.mark.parametrize("name", [p.name for p in recorded_programs()[::60]])
def test_rows_are_independent_in_any_batch_shape(name):
    program = PROGRAMS[name]
    graph, inputs = read_program(program), make_inputs(program, rows=24, dtype=np.float32)
    factors = evaluate(graph, inputs)["factors"]
    shaped = evaluate(graph, {key: array.reshape(2, 3, 4, -1) for key, array in inputs.items()})["factors"]
    single = evaluate(graph, {key: array[5] for key, array in inputs.items()})["factors"]
    empty = evaluate(graph, {key: array[:0] for key, array in inputs.items()})["factors"]
    np.testing.assert_allclose(shaped.reshape(factors.shape), factors, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(single, factors[5], rtol=1e-5, atol=1e-5)
    assert empty.shape == (0, graph.n_factors)
    assert factors.dtype == np.float32


@pytest.mark.parametrize("index", range(6))
def test_program_agrees_in_jax(index):
    program = PROGRAMS[sorted(SHORT)[3 + 12 * index]]
    graph, inputs = read_program(program), make_inputs(program, dtype=np.float32)
    expected = evaluate(graph, inputs)["factors"]
    transform = jax.vmap if index % 2 else lambda function: function
    result = np.asarray(jax.jit(transform(lambda inputs: evaluate(graph, inputs, jnp)["factors"]))(inputs))
    close = np.isclose(result, expected, rtol=2e-4, atol=2e-5, equal_nan=True)
    assert close.mean() > 0.995, (result[~close], expected[~close])  # a threshold may fall the other way


STATEMENTS = [
    # Copies and views.
    "x = x.copy()\nm = x > 0\nv = x[m]\nx[m] = 0\nx[m] = v * 2\ny = x",
    "x, y = x.copy(), x * 2\nm = x > 0\nx[m], y[m] = y[m], x[m]",
    "x, y = x.copy(), 0\nfor p in (1, 2, 3):\n    term = x ** p\n    term *= 0.5\n    y = y + term",
    "x = x.copy()\ny = +x\ny[:, 0] = 100\ny = x",
    "x = x.copy()\ny = np.positive(x)\ny[:, 0] = 100\ny = x",
    "x = x.copy()\ny = np.ascontiguousarray(x[:, :2])\ny[:] = 0\ny = x",
    "x = x.copy()\ny = np.ascontiguousarray(x)\ny[:] = 0\ny = x",
    "x = x.copy()\nv = x[:, 0].ravel()\nv += 100\ny = x",
    "x = x.copy()\nv = x[:, :3].reshape(-1)\nv += 100\ny = x",
    "x = x.copy()\nv = x.reshape(-1)\nv += 100\ny = x",
    "x = x.copy()\nv = x.reshape(-1, 2, 3)[:, 0].ravel()\nv += 100\ny = x",
    "x = x.copy()\nv = x.reshape(-1, 2, 3)[:, 0]\nv += 100\ny = x",
    "y = x[:, 0:1].ravel()\ny *= 2",
    "x = x.copy()\nfor k in np.arange(3):\n    v = x[:, k]\n    v *= 2\ny = x",
    "x = x.copy()\nv = np.take(x, 0, axis=1)\nv += 1\nv = np.logaddexp.reduce(x[:, :1], axis=1)\nv += 1\ny = x",
    "x = x.copy()\nv = np.maximum.accumulate(x[:, :1], axis=1)\nv += 1\nv = np.clip(x, None, None)\nv += 1\ny = x",
    "x = x.copy()\nv = np.linalg.eigvalsh(x[:, :1, None])\nv += 1\nnp.atleast_1d(x, action)[0][:, 0] = 9\ny = x",
    "v = [np.zeros_like(x)] * 2\nd = {0: v[0]}\nv[1] += x\nd[0] *= 2\ny = v[0]",
    # Numbers.
    "y = np.where(x > x.min(axis=1, keepdims=True), np.arange(6), np.iinfo(np.int64).max).min(1)",
    "y = np.polynomial.chebyshev.chebval(np.tanh(x[:, :1]), [0] * 30 + [1])",
    "y = np.polynomial.laguerre.lagval(x, [1, 2, 3])",
    "y = np.apply_along_axis(lambda r: np.sum(r[0]) * 1.0, 1, x)",
    "y = np.linalg.norm(x.reshape(-1, 2, 3), ord=1, axis=(2, 1))",
    "y = np.gradient(np.where(x > 1, np.inf, x), axis=1)",
    "y = np.median(np.where(x > -9, np.inf, x), axis=1)",
    "y = np.interp(x, [0, 90, 180], [1.0, 2.0, 3.0], period=-360)",
    "y = len(np.poly1d([0, 1, 2]).coeffs) + np.poly1d([0, 0]).coeffs[0]",
    "y = np.interp(x, [0, 1, 1], [5, 7, 9], right=8) + np.interp(np.rint(x), [0, 1, 1], [5, 7, 9]) + np.interp(x, [1], [3])",
    "b = x > 0\ny = np.rint(b) + np.rint(b) + np.round(b) + np.round(b) + np.reciprocal(b & ~b)",
    "y = np.rint(np.arange(6)) * np.ones_like(x)\nz = np.rint(np.arange(6))\nz[0] = 0.5\ny = y + z",
    "i = np.arange(6) + (x > 0)\nz = np.round(i, 1) + np.nanmax(i, axis=1, keepdims=True)\nz[:, 0] = 0.5\ny = z",
    "y = np.insert(np.arange(6) + (x > 0), 0, 0.5, axis=1)",
    "y = np.modf(np.where(x > 1, np.inf, x))[0]",
    "y = np.vectorize(lambda v: v * 2, otypes=[int])(x)",
    # Types, and objects.
    "y = (type(3) is int) + 2 * ((x > 0).dtype == bool) + 4 * (np.arange(3).dtype == int) + 8 * (type(3) is float)",
    "y = isinstance(np.array([1.0, 2.0]).max(), float) + 2 * (np.arange(3).dtype == 'int64') + 4 * (np.float32 == float)",
    "c = np.array([1, 2])\ny = sum(2**k * isinstance(v, t) for k, (v, t) in enumerate([(c[0], np.integer), (c[0], int), (c[0], np.ndarray),"
    " (c.mean(), np.floating), (c[0] > 0, np.bool_), (c, np.ndarray)])) + 64 * np.isscalar(c[0])",
    "from collections import namedtuple\nP = namedtuple('P', 'a b')\np = P(1, 2)\n"
    "y = (p == P(1, 2)) + 2 * (p == (1, 2)) + 4 * isinstance(p, tuple) + 8 * (P(1, 3) > p) + 16 * len(p) + 64 * (2 in p) + 128 * bool(p)",
    "from dataclasses import dataclass\n@dataclass\nclass P:\n    a: float\n    b: float\n"
    "y = (P(1, 2) == P(1, 2)) + 2 * (P(1, 2) != P(1, 3)) + 4 * (P(1, 2) == (1, 2))",
    "class A:\n    def __init__(self, n):\n        self.n = n\n    def __eq__(self, other):\n        return self.n == other.n\n"
    "    def __lt__(self, other):\n        return self.n < other.n\n    def __len__(self):\n        return self.n\n"
    "    def __contains__(self, k):\n        return k < self.n\na, b = A(0), A(2)\n"
    "y = (a == A(0)) + 2 * (a != b) + 4 * (a < b) + 8 * (a > b) + 16 * (not a) + 32 * len(b) + 128 * (1 in b)",
    "class A:\n    pass\na, b = A(), A()\ny = (a == a) + 2 * (a == b) + 4 * (a is a) + 8 * (a != 3) + 16 * bool(a)",
    "class A:\n    v = 0\na, b = A(), A()\nit = iter([a, b])\nnext(it).v += 1\ny = a.v + 2 * b.v",
    "class A:\n    k = 1\n    def f(self):\n        return self.k + self.g()\n    def g(self):\n        return 10\n"
    "class B(A):\n    k = 2\n    def f(self):\n        return 100 + super().f()\n    def g(self):\n        return 20\ny = B().f()",
    # Numbers of NumPy: keys, and how often a list is repeated.
    "d, k = {0: 5, 1: 7}, np.argmax([1, 2])\ny = d.get(k, 0) + 10 * (k in d) + 20 * (k in {0, 1}) + d.pop(k, 50)\n"
    "y += d.setdefault(k, 3) + d[1]",
    "n = np.max([2, 3])\ny = len([0.0] * n) + 10 * len(n * (0,))",
    # Iterators.
    "it = iter([1, 2, 3, 4])\nfor v in it:\n    if v == 2:\n        break\ny = sum(it)",
    "it = iter([1, 2])\ny = {next(it): next(it)}[1]",
    "y = dict(values={'k': 2})['values']['k'] + sum(itertools.repeat(0.5, 3)) + (3.0 in np.eye(2)) + (1.0 in np.eye(2))",
    "y = {0: 5, 1: 7}[np.argmax(np.array([1, 2]))] if len(x) else 3",
    "sum = x.sum(axis=1)\ny = sum.reshape(-1, 1)",
]


@pytest.mark.parametrize("statements", STATEMENTS)
def test_statements_agree_with_numpy(statements):
    """Each program computes y from x, the observation. The factor is a weighted sum of y."""
    source = "import itertools\nimport numpy as np\n" + phi_source(
        f"x = observation\n{statements}\ny = (y * np.ones_like(action) if np.ndim(y) == 0 else y).reshape(len(action), -1)\n"
        "return [np.sum(y * np.arange(1, y.shape[1] + 1), axis=1, keepdims=True)]"
    )
    graph, inputs = read(source, 6, 3), dict(zip(("observation", "action"), random_inputs((6, 3), 9), strict=True))
    check_equal(evaluate(graph, inputs)["factors"], execute_program(source, **inputs), 1e-5)


@pytest.mark.parametrize("xp", [np, jnp])
def test_integers_never_fail(xp):
    expressions = {
        "(observation[:, :1] > 0).astype(int) // 0": 0,
        "np.array([5, 7])[(observation[:, :1] * 0 + 9).astype(int)]": 7,  # beyond the end: the last entry
        "np.array([5, 7])[(observation[:, :1] * 0 - 9).astype(int)]": 5,  # before the beginning: the first entry
        "(observation[:, :1] * 0 + 1e20).astype(int)": 2**31 - 128,
        "np.sum(observation[:, :2] > -99, axis=1, keepdims=True)": 2,
        "(observation[:, :1] * 2).astype(int) ** (action - 2).astype(int)": 1,
    }
    graph = read("import numpy as np\n" + phi_source(f"return [{', '.join(expressions)}]"), 2, 1)
    inputs = {"observation": np.ones((2, 2), np.float32), "action": np.ones((2, 1), np.float32)}
    np.testing.assert_array_equal(evaluate(graph, inputs, xp)["factors"], [list(expressions.values())] * 2)


@pytest.mark.parametrize("name", REFUSED)
def test_program_is_refused(name):
    program = ALL_PROGRAMS[name]
    with pytest.raises(RefusedError, match=r"^E-[A-Z]+ line \d+: "):
        read(program.source, *program.sizes)


@pytest.mark.parametrize("number", [n if n < 4 else long_case(n) for n in range(len(repaired_programs()))])
def test_refusal_was_enough_to_mend_the_program(number):
    """A language model that saw a refused program and its errors, and nothing else, wrote `mended.json` at the first try."""
    entry = repaired_programs()[number]
    program = ALL_PROGRAMS[entry["name"]]
    graph, inputs = read(entry["code"], *program.sizes), make_inputs(program)
    check_equal(evaluate(graph, inputs, dtype=np.float64)["factors"], execute_program(program.source, **inputs), 1e-6)
