"""Compiled programs: no state, fuel that ends, and no way out."""

import types

import numpy as np
import pytest

from lare.latent.language import program as module
from lare.latent.language.program import FUEL, OutOfFuel, Program, namespace
from programs import batch, run, run_plainly
from toys import PHI, phi


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


# --- fuel ------------------------------------------------------------------------------------------------------------


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


# --- no way out ------------------------------------------------------------------------------------------------------


def test_no_module_can_be_reached_by_name():
    names = namespace()
    assert set(names.pop("__builtins__")) == {"__import__"}
    assert not [name for name, value in names.items() if isinstance(value, types.ModuleType)]
    # What no source can spell is what the rewriting puts there.
    spelled = {name for name in names if name.isidentifier()}
    assert spelled == set(
        "abs all any bool dict enumerate float int len list max min reversed round slice sorted sum tuple zip".split()
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


def test_functions_can_be_watched():
    seen = []
    watched = Program(phi("return [np.tanh(np.abs(action))]"), {"numpy.tanh": lambda x: seen.append(x) or x})
    np.testing.assert_array_equal(watched(*batch()), [np.abs(batch()[1])])
    assert len(seen) == 1
