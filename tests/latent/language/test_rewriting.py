"""Rewriting: the same results as Python's own, lines that stay, and nothing evaluated that only describes."""

import json
import math
import traceback
from pathlib import Path

import numpy as np
import pytest

from lare.latent.language.program import FILE, Program
from programs import batch, run_plainly
from toys import phi

CASES = json.loads(Path(__file__).parents[1].joinpath("cases.json").read_text(encoding="utf-8"))
BENIGN = {case["name"]: case["code"] for case in CASES["benign"]}

ODDITIES = {
    "nested functions": "def f(x):\n    def g(y):\n        return y * x\n    return g(2) + g(3)\nreturn [action * f(2)]",
    "defaults": "def f(x, y=2, *, z=(1, -3)):\n    return x * y ** z[0] - z[1]\nreturn [action * f(1, 3, z=(2, f(1)))]",
    "a lambda in a loop": "f = lambda x, k=2: x ** k\ny = 0\nfor i in range(4):\n    y += f(i)\nreturn [action * y]",
    "a loop with else": "y = 1\nfor i in range(3):\n    y *= 2\nelse:\n    y **= 2\nreturn [action * y]",
    "break and continue": (
        "y = []\nfor i in range(9):\n    if i % 2: continue\n    if i > 5: break\n    y.append(i)\nreturn [np.array(y)]"
    ),
    "generators": "return [sum(x * y for x in range(4) if x % 2 for y in [1, 2] if y > x - 2) * action]",
    "comprehensions": "x = {k: k ** 2 for k in range(4) if k}\nreturn [action * v for k, v in x.items()]",
    "a dictionary": (
        "x = {'a': 2, 'b': 3}\ny = x.get('c', 4)\nx['d'] = 5\nreturn [action * x[k] * y for k in x if 'a' in x]"
    ),
    "powers": "return [np.array([2 ** 3 ** 1, (-2) ** 2, -2 ** 2, 2 ** -1, 0.5 ** 0.5]), action ** 2, 2 ** action]",
    "products": "return [np.array(2 * [1, 2] + [1] * 0 + [True * 3, 3 * 0.5]), np.array((1, 2) * 2), action * action[:, :1]]",
    "augmented": (
        "x = action.copy()\ny = x\nx *= 2\nx **= 2\nx[:, 0] *= 3\nx[1:, 1:3] **= 2\nx -= 1\ny[0] = 7\nreturn [x, y]"
    ),
    "augmented once": (
        "x, y = [1, 2, 3], [0, 1, 2]\ndef f(z):\n    z.append(len(z))\n    return z[-1] - 3\n"
        "x[f(y)] += 10\nx[f(y)] *= f(y)\n[x, y][y.pop(0)][-1] -= f(y)\n"
        "def g(z):\n    z[0] = 7\n    return 1\nx[0] += g(x)\nx[x[0] - 8 : 1 + g(x)] += [5]\nreturn [np.array(x), np.array(y)]"
    ),
    "augmented slices": (
        "x = np.arange(24.0).reshape(4, 6)\nx[1:, ::2] *= 2\nx[..., -1] -= 1\nx[:2][1:] += 3\nx[None, 0, :] /= 4\n"
        "y = [x]\ny[0][(1, 2)] **= 2\ny[-1][[0, 2]] //= 3\nreturn [x]"
    ),
    "augmented lists": "x = [1, 2]\ny = x\nx *= 2\nx += [5]\nx[0] *= 9\nreturn [np.array(x), np.array(y)]",
    "annotations": "x: np.ndarray = action\ny: int\ny = 2\nreturn [x * y]",
    "tuples": "(a, b), c = (1, 2), 3\nd = e = a\nreturn [action * (a + b * c - d / e)]",
    "conditions": "return [action * (1 if 0 < len(action) <= 5 and not None else 2) * (3 in [3]) * (4 not in [3])]",
    "constants": "return [action * np.pi * math.tau, np.array([np.inf, np.finfo(np.float32).eps]), action[:, np.newaxis]]",
    "errstate": "with np.errstate(divide='ignore', invalid='ignore'):\n    x = action / 0\nreturn [np.nan_to_num(x)]",
    "methods": "return [action.T.sum(0), action.reshape(-1), action.astype('f8').cumsum(1), action.clip(0, max=1)]",
    "reductions": "return [np.add.reduce(action, axis=1), np.maximum.reduce(action), np.linalg.norm(action, axis=1)]",
    "ranges": "return [np.array(list(range(1, 9, 3)) + list(reversed(range(3))) + [len(range(0))])]",
    "a docstring": "'''What it is.'''\nreturn [action]",
    "no factors": "return []",
}


@pytest.mark.parametrize("source", [*BENIGN.values(), *map(phi, ODDITIES.values())], ids=[*BENIGN, *ODDITIES])
def test_a_program_means_what_python_takes_it_to_mean(source):
    def compare(found, expected):
        assert type(found) is type(expected)
        if isinstance(expected, list | tuple):
            assert len(found) == len(expected)
            for one, other in zip(found, expected, strict=True):
                compare(one, other)
        elif isinstance(expected, np.ndarray):
            assert found.dtype == expected.dtype
            np.testing.assert_array_equal(found, expected)
        else:
            assert found == expected

    compare(Program(source)(*batch()), run_plainly(source))


@pytest.mark.parametrize(
    ("source", "line"),
    [
        ("import numpy as np\n\n" + phi("'''Two\nlines.'''\nx = 1\nreturn [action / (x - 1) + np.zeros(3)]"), 7),
        (phi("x = [1, 2]\nreturn [\n    action,\n    x[\n    5],\n]"), 5),
        (phi("x = (\n    i\n    for i in range(3)\n    if [][i]\n)\nreturn [x]"), 5),
        (phi("x = [\n    j\n    for i in range(3)\n    for j in [1][9:][0]\n]"), 5),
        (phi("f = (\n    lambda x:\n    x[7]\n)\nf([1])"), 4),
        (phi("x = [1]\nx[\n    3\n] *= 2"), 3),
        (phi("x = [1]\nx[\n    [][1]\n] *= 2"), 4),
        (phi("x = [1]\n\nx *= (\n    1 / 0)"), 5),
        (phi("with np.errstate(all='ignore'):\n    pass\n    np.zeros((2, 3)) + np.zeros(4)"), 4),
        (phi("for i in range(2):\n    pass\n\n    action[99]"), 5),
        (phi("x: int = 1\ny: float = (\n    [][1])"), 4),
        ("X = [1, 2]\nY = (\n    X[7])\n" + phi("return [action]"), 3),
        ("def f(x):\n    # Words.\n    return x[9]\n\n" + phi("return [f([1])]"), 3),
        (phi("\n\nreturn [10 ** 10000]"), 4),
        (phi("return [\n    range(10 ** 9)]"), 3),
    ],
)
def test_an_error_has_the_line_of_the_source(source, line):
    with pytest.raises(Exception) as error:  # noqa: PT011
        Program(source)(*batch())
    frames = traceback.extract_tb(error.value.__traceback__)
    assert [frame.lineno for frame in frames if frame.filename == FILE][-1] == line


def test_what_the_gate_cannot_see_does_not_compile():
    with pytest.raises(SyntaxError, match="'break' outside loop") as error:
        Program(phi("x = 1\nbreak"))
    assert error.value.lineno == 3


def test_annotations_are_never_evaluated():
    source = (
        "def evaluation_func(observation: 1 / 0, action: nobody[''], /) -> nothing:\n"
        "    def f(x: 1 / 0 = 1, *, y: nobody = 2) -> 1 / 0: return x\n"
        "    x: 1 / 0 = 1\n    y: nobody\n    return [action * f(x)]"
    )
    np.testing.assert_array_equal(Program(source)(*batch()), [batch()[1]])


def test_imports_do_nothing():
    # They were checked by the gate; what they would bind is not what the names mean.
    source = "import os\nfrom os import system\nimport sys as np\n" + phi(
        "import os as math\nreturn [np.abs(action) * math.pi]"
    )
    np.testing.assert_array_equal(Program(source)(*batch()), [np.abs(batch()[1]) * math.pi])
    with pytest.raises(NameError):
        Program("import os\n" + phi("return [os]"))(*batch())
