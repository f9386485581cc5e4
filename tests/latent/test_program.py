"""Rewriting and compiling: the same results as Python's own, lines that stay, no state, no way out, and fuel."""

import json
import math
import traceback
import types
from pathlib import Path

import numpy as np
import pytest

from lare.latent import program as module
from lare.latent.program import FILE, FUEL, OutOfFuel, Program, TooLarge, namespace
from toys import PHI, phi

CASES = json.loads(Path(__file__).with_name("cases.json").read_text(encoding="utf-8"))
BENIGN = {case["name"]: case["code"] for case in CASES["benign"]}


def batch(rows: int = 5) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(3)
    observation, action = random.standard_normal((rows, 17)), random.uniform(-1, 1, (rows, 6))
    return observation.astype(np.float32), action.astype(np.float32)


def run(body: str):
    """Runs some lines as a program."""
    return Program(phi(f"{body}\nreturn [action]"))(*batch())


def run_plainly(source: str):
    """What a program returns as Python has it."""
    names = {"np": np, "math": math}
    exec(compile(source, FILE, "exec"), names)
    return names["evaluation_func"](*batch())


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


# --- state -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "source",
    [
        "CALLS = [0]\ndef count(x):\n    x[0] += 1\n    return x[0]\n" + phi("return [action * count(CALLS)]"),
        "CALLS = []\ndef count(x):\n    x.append(1)\n    return len(x)\n" + phi("return [action * count(CALLS)]"),
        "CALLS = np.zeros(1)\ndef count(x):\n    x += 1\n    return x[0]\n" + phi("return [action * count(CALLS)]"),
        "CALLS = {'a': 0}\ndef count(x):\n    x['a'] += 1\n    return x['a']\n" + phi("return [action * count(CALLS)]"),
        "CALLS = [[1, 2, 3]]\ndef count(x): return x.pop()\n" + phi("return [action * count(CALLS[0])]"),
    ],
)
def test_nothing_survives_a_call(source):
    program = Program(source)
    first, second = program(*batch()), program(*batch())
    np.testing.assert_array_equal(first, second)
    # Within one call there is state, as Python has it.
    np.testing.assert_array_equal(first, run_plainly(source))


def test_floating_point_errors_are_this_processs_again():
    before = np.geterr()
    Program(phi("with np.errstate(all='ignore'):\n    return [1 / (action * 0)]"))(*batch())
    assert np.geterr() == before


# --- fuel and growth -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("body", "steps"),
    [
        ("return [action]", 1),
        ("for i in range(7): pass\nreturn [action]", 8),
        ("for i in range(3):\n    for j in range(4): pass\nreturn [action]", 1 + 3 + 12),
        ("x = [i for i in range(5) for j in range(2)]\nreturn [action]", 1 + 5 + 10),
        ("x = sum(i for i in range(5) if i > 3)\nreturn [action]", 6),
        ("x = {i: i for i in range(5)}\nreturn [action]", 6),
        ("f = lambda x: x\nf(1)\nf(2)\nreturn [action]", 3),
        ("def f(x): return x\nf(f(1))\nreturn [action]", 3),
        ("for row in action: pass\nreturn [action]", 6),
    ],
)
def test_turns_and_calls_are_counted(body, steps):
    program = Program(phi(body))
    for _ in range(2):
        program(*batch(5))
        assert program.steps == steps


def test_what_stands_outside_of_the_function_counts_as_well():
    program = Program("X = [i for i in range(5)]\n" + phi("return [action]"))
    program(*batch())
    assert program.steps == 6


@pytest.mark.parametrize(
    "body",
    [
        "for i in range({}): pass",
        "x = [1 for i in range({})]",
        "x = sum(1 for i in range({}))",
        "f = lambda: 1\nfor i in range({} // 2): f()\nif {} % 2: f()",
    ],
)
def test_fuel_has_an_end(body, monkeypatch):
    monkeypatch.setattr(module, "FUEL", 100)
    assert len(run(body.replace("{}", "99"))) == 1
    with pytest.raises(OutOfFuel, match=r"\Amore than 100 turns of loops and calls\Z"):
        run(body.replace("{}", "100"))


def test_how_much_fuel_there_is():
    with pytest.raises(OutOfFuel, match=f"more than {FUEL} turns of loops and calls"):
        run(f"for i in range({FUEL}): pass")


def test_calls_that_multiply_run_out_of_fuel():
    functions = "".join(f"def f{i}(): return f{i + 1}() + f{i + 1}()\n" for i in range(40))
    with pytest.raises(OutOfFuel):
        Program(functions + "def f40(): return 1\n" + phi("return [f0()]"))(*batch())


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("range(100_001)", "a sequence of 100001 entries"),
        ("sum(range(10 ** 12))", "a sequence of 1000000000000 entries"),
        ("list(range(0, -(10 ** 9), -2))", "a sequence of 500000000 entries"),
        ("[1, 2] * 5001", "a sequence of 2 entries, 5001 times"),
        ("5001 * (1, 2)", "a sequence of 2 entries, 5001 times"),
        ("[[1] * 10_000] * 10_001", "a sequence of 1 entries, 10001 times"),
        ("x = [1, 2]\nx *= 5001", "a sequence of 2 entries, 5001 times"),
        ("x = [[1, 2]]\nx[0] *= 5001", "a sequence of 2 entries, 5001 times"),
        ("for k in {'ab': 1}:\n    k * 5001", "a sequence of 2 entries, 5001 times"),
        ("2 ** 4097", "a power of integers"),
        ("2 ** 9 ** 9", "a power of integers"),
        ("x = 2\nx **= 4097", "a power of integers"),
        ("2 ** -4097", "a power of integers"),
        ("x = 2 ** 2000\nx * x * x", "a product of huge integers"),
        ("x = 2 ** 2000\nfor i in range(9): x *= x", "a product of huge integers"),
    ],
)
def test_growth_without_a_loop_has_an_end(body, message):
    with pytest.raises(TooLarge) as error:
        run(body)
    assert str(error.value) == message


@pytest.mark.parametrize("body", ["range(20_000)", "[1, 2] * 5000", "2 ** 2047", "x = 2 ** 1000\nx * x", "1.5 ** 500"])
def test_growth_up_to_the_end(body):
    assert len(run(body)) == 1


# --- no way out ------------------------------------------------------------------------------------------------------


def test_no_module_can_be_reached_by_name():
    names = namespace()
    assert set(names.pop("__builtins__")) == {"__import__"}
    assert not [name for name, value in names.items() if isinstance(value, types.ModuleType)]
    # What no source can spell is what the rewriting puts there.
    spelled = {name for name in names if name.isidentifier()}
    assert spelled == set(
        "abs all any bool dict enumerate float int len list max min reversed round sorted sum tuple zip".split()
    )


def test_what_is_imported_later_is_of_numpy_and_there_already():
    load = namespace()["__builtins__"]["__import__"]
    assert load("numpy.linalg") is np.linalg
    for name in ("os", "sys", "numpyro", "numpy.not_there", "subprocess", "importlib"):
        with pytest.raises(ImportError):
            load(name)


def test_each_program_has_names_of_its_own():
    one, other = Program(PHI), Program(PHI)
    assert one.make.__globals__ is not other.make.__globals__


def test_annotations_are_never_evaluated():
    source = (
        "def evaluation_func(observation: 1 / 0, action: nobody[''], /) -> nothing:\n"
        "    def f(x: 1 / 0 = 1, *, y: nobody = 2) -> 1 / 0: return x\n"
        "    x: 1 / 0 = 1\n    y: nobody\n    return [action * f(x)]"
    )
    np.testing.assert_array_equal(Program(source)(*batch()), [batch()[1]])


def test_functions_can_be_watched():
    seen = []
    watched = Program(phi("return [np.tanh(np.abs(action))]"), {"numpy.tanh": lambda x: seen.append(x) or x})
    np.testing.assert_array_equal(watched(*batch()), [np.abs(batch()[1])])
    assert len(seen) == 1


def test_imports_do_nothing():
    # They were checked by the gate; what they would bind is not what the names mean.
    source = "import os\nfrom os import system\nimport sys as np\n" + phi(
        "import os as math\nreturn [np.abs(action) * math.pi]"
    )
    np.testing.assert_array_equal(Program(source)(*batch()), [np.abs(batch()[1]) * math.pi])
    with pytest.raises(NameError):
        Program("import os\n" + phi("return [os]"))(*batch())
