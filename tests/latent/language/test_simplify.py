"""What can be said in other words: it means what Python means by it, and the gate sees through it."""

import numpy as np
import pytest

from lare.latent.language.gate import inspect
from lare.latent.language.program import Program
from programs import batch, run_plainly
from toys import phi

NATURAL = {
    "a function of NumPy by its name": "from numpy import sqrt, abs as size\n" + phi("return [sqrt(size(action[:, :1]))]"),
    "norm by its name": "from numpy.linalg import norm\n" + phi("return [norm(action, axis=1, keepdims=True)]"),
    "linalg by its name": "from numpy import linalg as la\n" + phi("return [la.norm(action, axis=1, keepdims=True)]"),
    "linalg imported": "import numpy.linalg as la\n" + phi("return [la.norm(action, axis=1, keepdims=True)]"),
    "a function of math": "from math import sqrt, pi\n" + phi("return [action[:, :1] * sqrt(2) * pi]"),
    "an import within": phi("from numpy import sum as total\nreturn [total(action, axis=1, keepdims=True)]"),
    "a dtype by its name": "from numpy import float32\n" + phi("return [action[:, :1].astype(float32)]"),
    "a helper that takes a string": (
        "INDEX = {'vx': 8, 'vz': 9}\n"
        + phi("def get(name, unit='none'): return observation[:, INDEX[name]:INDEX[name] + 1]\nreturn [get('vx'), get(name='vz')]")
    ),
    "map with a lambda": phi("return list(map(lambda i: observation[:, i:i + 1] ** 2, [1, 3]))"),
    "map of two": phi("return list(map(lambda i, s: s * action[:, i:i + 1], [1, 3], [0.5, 2.0]))"),
    "map with a function": phi("x = sum(map(abs, [-1, 2]))\nreturn list(map(np.square, [action[:, :1], x * action[:, 1:2]]))"),
    "filter": phi("return [action[:, i:i + 1] for i in filter(lambda i: i % 2, range(4))]"),
    "assert": phi("assert observation.ndim == 2, 'two dimensions, please!'\nreturn [action[:, :1]]"),
    "a starred target": phi("first, *rest = [action[:, i:i + 1] for i in range(3)]\nreturn [first, rest[0] + rest[1]]"),
    "a starred target of a tuple": phi("*rest, last = (1.0, 2.0, action[:, :1])\nreturn [last * rest[0] * rest[1]]"),
    "a starred list": phi("a, b = [action[:, :1]], (action[:, 1:2],)\nreturn [*a, *b, action[:, 2:3]]"),
    "a starred tuple": phi("a = [action[:, :1]]\nreturn list((*a, 2 * a[0]))"),
    "the walrus": phi("if (n := action.shape[1]) > 2: x = action[:, :1] * n\nelse: x = action[:, :1]\nreturn [x]"),
    "the walrus in a list": phi("x = [y * y for i in range(3) if (y := i + 1) > 1]\nreturn [action[:, :1] * sum(x)]"),
    "constants of slice": "VX = slice(8, 9)\n" + phi("head = slice(3)\nreturn [observation[:, VX], observation[:, head][:, :1]]"),
    "a list of strings": (
        "NAMES = ['x', 'y']\n"
        + phi("c = {n: action[:, i:i + 1] for i, n in enumerate(NAMES)}\nreturn [c[n] for n in NAMES if n != 'z']")
    ),
    "a choice by a string": phi("mode = 'sum'\nx = action[:, :1] if mode == 'sum' else -action[:, :1]\nreturn [x]"),
    "a main": phi("return [action[:, :1]]") + "\nif __name__ == \"__main__\":\n    print(evaluation_func(1, 2))\n    open('x')\n",
    "dict by keywords": phi("w = dict(speed=2.0, effort=0.5)\nreturn [action[:, :1] * w['speed'] * w['effort']]"),
    "keywords of clip": phi("return [np.clip(action[:, :1], a_min=-0.5, a_max=0.5), np.clip(action[:, :1], min=0.1, max=None)]"),
    "clip from one side": phi("return [np.clip(action[:, :1], a_min=0.0, a_max=None)]"),
    "infinity": phi("return [np.minimum(action[:, :1], float('inf')), np.maximum(action[:, :1], -float('Infinity'))]"),
    "a power of a root": phi("return [np.abs(action[:, :1]) ** 2.0 ** 0.5]"),
}  # fmt: skip


@pytest.mark.parametrize("source", NATURAL.values(), ids=NATURAL)
def test_it_means_what_python_means_by_it(source):
    assert inspect(source) == []
    expected = run_plainly(source.partition("\nif __name__")[0])
    found = Program(source)(*batch())
    assert len(found) == len(expected)
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("from numpy import load\n" + phi("return [load('x')]"),
         "E-NUMPY line 3: np.load is not available: it reads or writes files"),
        ("from numpy import random as r\n" + phi("return [r.rand(3)]"),
         "E-NUMPY line 3: np.random.rand is not available: it depends on chance"),
        ("from numpy import sqrt\n" + phi("f = sqrt\nreturn [f(action)]"),
         "E-VALUE line 3: np.sqrt is a function, and can only be called"),
        ("from numpy import sqrt as f\n" + phi("f = 1\nreturn [action]"),
         "E-IMPORT line 1: from numpy import: write `import numpy as np` and the function's full name"),
        ("from numpy.random import rand\n" + phi("return [rand(3)]"),
         "E-IMPORT line 1: from numpy.random import: write `import numpy as np` and the function's full name"),
        (phi("return list(map(lambda *x: x, [1]))"),
         "E-CALL line 2: map is not a function that is available; write a list comprehension"),
        (phi("return [x for x in map(open, [1])]"), "E-CALL line 2: open is not a function that is available"),
        (phi("return list(map(lambda x: x.base, [action]))"), "E-ATTRIBUTE line 2: .base is not available"),
        (phi("return [np.abs(*[action])]"), "E-CALL line 2: * and ** in a call are not available"),
        (phi("(a, *b), c = [[1, 2], 3]\nreturn [action]"),
         "E-CONSTRUCT line 2: * is available in lists, and once on the left of an assignment"),
        (phi("for a, *b in [[1, 2]]: pass\nreturn [action]"),
         "E-CONSTRUCT line 2: * is available in lists, and once on the left of an assignment"),
        (phi("x = dict(**{'a': 1})\nreturn [action]"), "E-CALL line 2: * and ** in a call are not available"),
        (phi("x = dict(__class__=1)\nreturn [action]"), None),
        (phi("if (np := 1): pass\nreturn [action]"), "E-DEFINITION line 2: np has a meaning already; choose another name"),
        (phi("x = float('nan')\nreturn [action]"), "E-STRING line 2: float takes no string here: 'nan'"),
        (phi("return [np.sum(action, axis='abc')]"), "E-STRING line 2: np.sum takes no string here: 'abc'"),
        (phi("x = [observation for i in range(3) if i == '%s']\nreturn [action]"),
         "E-STRING line 2: the string '%s' is no plain word: letters, digits, spaces, _ and - only"),
        (phi("if isinstance(action, np.ndarray): pass\nreturn [action]"), "E-NUMPY line 2: np.ndarray is not available: "
         "np.array, np.asarray and np.zeros make arrays, and whatever is given is one"),
        (phi(f"x = {'9' * 5000}\nreturn [action]"), "E-NUMBER line 2: an integer is larger than 2**63"),
        ("if __name__ == '__main__':\n    pass\nelse:\n    x = 1\n" + phi("return [action]"),
         "E-MODULE line 1: only imports, functions and constants may stand outside of functions"),
        (phi(f"x = [{', '.join(['*action'] * 120)}]\nreturn x"), "E-SIZE line 1: the expressions are nested more than 100 deep"),
    ],
)  # fmt: skip
def test_the_gate_sees_through_it(source, message):
    said = [str(problem) for problem in inspect(source)]
    assert (message in said) if message else (said == [])


def test_what_an_assert_and_a_main_say_is_never_run():
    source = phi("assert open('x'), np.load('y')\nreturn [action[:, :1]]")
    assert inspect(source) == []
    assert len(Program(source)(*batch())) == 1


def test_a_starred_target_takes_no_array_apart():
    with pytest.raises(Exception, match="a sequence of 20001 entries"):
        Program(phi("first, *rest = np.zeros(20001)\nreturn [action]"))(*batch())
