"""Functions of Python's own modules give Python's numbers."""

import collections
import collections.abc
import functools
import itertools
import math
import operator

import numpy as np
import pytest

from helpers.toy_envs import phi_source
from lare_rl.phi.evaluate import evaluate
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.read import read

MODULES = {module.__name__: module for module in (math, itertools, functools, operator, collections)}
EXPRESSIONS = """
    math.acos(0.3) | math.acosh(1.5) | math.asin(0.3) | math.asinh(0.3) | math.atan(2) | math.atan2(1, -2) | math.atanh(0.3)
    math.ceil(1.2) | math.ceil(-1.2) | math.floor(-1.2) | math.trunc(-1.7) | math.copysign(3, -0.0) | math.fabs(-2)
    math.cos(1) | math.cosh(1) | math.sin(1) | math.sinh(1) | math.tan(1) | math.tanh(1) | math.degrees(1) | math.radians(90)
    math.erf(0.5) | math.erfc(0.5) | math.gamma(4.5) | math.lgamma(4.5) | math.exp(1) | math.expm1(0.1)
    math.log(8) | math.log(8, 2) | math.log10(1000) | math.log1p(0.1) | math.log2(8) | math.sqrt(2) | math.pow(2, 0.5)
    math.fmod(-7, 3) | math.remainder(7, 4) | math.modf(1.25)[0] | math.hypot(3, 4) | math.dist([1, 2], [4, 6])
    math.isclose(1, 1 + 1e-12) | math.isclose(1, 1.1, rel_tol=0.2) | math.isfinite(1) | math.isinf(math.inf) | math.isnan(0)
    math.gcd(12, 18) | math.lcm(4, 6) | math.factorial(0) | math.factorial(20) | math.prod([2, 3, 4]) | math.prod([2], start=5)
    math.comb(5, 2) | math.comb(200, 2) | math.comb(200, 198) | math.comb(66, 33) | math.comb(3, 5) | math.comb(10 ** 6, 2)
    math.fsum([1e16, 1.0, -1e16]) | math.comb(10 ** 15, 1) | math.comb(5, 0) | math.pi + math.e + math.tau
    abs(-3) | pow(2, 10) | 7 // 2 | -7 // 2 | -7 % 3 | 7.5 % -2 | divmod(-7, 3)[1] | round(2.567, 1) | round(2.5) | int(-2.7)
    int('12') | float('1e-3') | bool(3) | max(3, 1, 2) | min([3, 1, 2]) | max([1, -3], key=abs) | sum([1, 2, 3], 4)
    len('abc') | len({1, 2, 2}) | sorted([3, 1, 2])[0] | sorted([3, 1, 2], reverse=True)[0] | list(reversed([1, 2]))[0]
    sum(i * x for i, x in enumerate([1, 2, 3], 1)) | sum(a * b for a, b in zip([1, 2], [3, 4])) | sum(range(2, 20, 3))
    sum(map(abs, [-1, -2])) | sum(filter(None, [0, 1, 2])) | next(iter([5, 6])) | any([0, 1]) | all([0, 1]) | len('ab' * 3)
    sum(a * b for a, b in itertools.combinations([1, 2, 3], 2)) | len(list(itertools.product([1, 2], [3, 4, 5])))
    len(list(itertools.permutations([1, 2, 3]))) | sum(itertools.accumulate([1, 2, 3])) | sum(itertools.chain([1], [2, 3]))
    sum(b - a for a, b in itertools.pairwise([1, 4, 9])) | sum(itertools.islice([1, 2, 3, 4], 2)) | sum(itertools.repeat(2, 3))
    len(list(itertools.combinations_with_replacement([1, 2, 3], 2))) | sum(itertools.starmap(pow, [(2, 3), (3, 2)]))
    sorted({1, 2, 3} - {2, 4})[1] | sum({1, 2} & {2, 3}) | sum({1, 2, 3} ^ {3, 4}) | sum({1}.union([2, 3])) | sum({1, 2}.difference([2]))
    functools.reduce(operator.mul, [1, 2, 3, 4]) | operator.itemgetter(1)([5, 6]) | operator.truediv(1, 4) | operator.neg(3)
    len('a b c'.split(maxsplit=1)) | len({1}.union([2], [3])) | len({1, 2, 3}.difference([1], [2])) | len({1}.union()) | float('.5')
    sum(f() for f in [lambda: n for n in range(3)]) | sum(a * b for a, b in zip(*[iter([1, 2, 3, 4])] * 2)) | operator.lshift(1, 3)
    len(list(itertools.repeat('ab', times=3))[0]) | len(list(itertools.repeat((1, 2, 3), 2))[1]) | len(list(itertools.zip_longest()))
    len(list(itertools.permutations(range(9), 3))) | len(list(itertools.zip_longest([1], [2, 3], fillvalue=100)))
    list(itertools.accumulate([1, 3, 2], func=max))[2] | sum(itertools.accumulate([1, 2], None)) | len(list(itertools.repeat('a', 2)))
    'secret' in str({'path': ['secret.txt']}) | len(str({'a': (1,), 2: []})) | len(repr({1.5}))
    len(list(itertools.product([1], repeat=0))) | len(f"{'a'!r}{set()}") | len(repr('a'))
    len(f'{5!s:>4}') | len(f'{None!s:6}') | len('{!r}'.format('a')) | len(f"{'é'!a}") | int('1_000') | int('1700000000000000000')
    float('1' + '0' * 70) | float('1_0.5') | list({5, 2, 0})[0] | {'a': 1, 'b': 2}.keys() == {'b': 2, 'a': 1}.keys()
    {'a': 1}.keys() == {'a'} | len({'a': 1, 'b': 2}.keys() & {'b', 'c'}) | list({3: 1, 1: 2}.keys())[0] | len(str({'a': 1}.keys()))
    {1, 2} < {1, 2, 3} | {1} <= {2} | {1, 2} == {2, 1} | 'a b'.rpartition(' ')[2] == 'b' | len('a b'.splitlines())
    isinstance('a', collections.abc.Sequence) | isinstance({}, collections.abc.Iterable) | isinstance(len, collections.abc.Callable)
    isinstance(range(3), collections.abc.Sequence) | hasattr([1], '__len__') | hasattr({}, '__iter__') | hasattr(5, '__len__')
    hasattr(np.float64(1), '__len__') | hasattr(lambda: 0, '__call__') | hasattr(len, '__call__') | callable(np.ndarray)
    isinstance({1}, (set, frozenset)) | isinstance(frozenset([1]), set) | isinstance({'a': 1}.keys(), (list, frozenset))
    {} == set() | {1: None} == {1} | [{}] == [set()] | frozenset([1, 2]) == {2, 1} | len(frozenset([1]) - {1}) | len(str(frozenset([1])))
    len(f"{['é']!a}") | len(dict({'ab': 1}.keys())) | iter([1]) == iter([1]) | sum({3, 10, 17, 24, 31}) | max({3, 10, 17, 24, 31})
    sorted({3, 10, 17, 24, 31})[1] | len({3, 10, 17, 24, 31} - {3})
    bool(x for x in []) | 1 if filter(None, [0]) else 0 | callable(len) | callable(5)
    collections.OrderedDict([('a', 2)])['a'] | float('%.3f' % 1.23456) | float('{:.1f}'.format(2.25)) | float(f'{1.5:.2f}')
"""


CASES = [[e.strip() for e in line.split("|")] for line in EXPRESSIONS.strip().split("\n")]


@pytest.mark.parametrize("expressions", CASES, ids=lambda expressions: expressions[0])
def test_number_is_that_of_python(expressions):
    factors = ", ".join(f"observation[:, :1] * 0 + ({expression})" for expression in expressions)
    graph = read(
        "import numpy as np\n" + "".join(f"import {name}\n" for name in MODULES) + phi_source(f"return [{factors}]"),
        17,
        6,
    )
    inputs = {"observation": np.ones((2, 17)), "action": np.ones((2, 6))}
    results = evaluate(graph, inputs, dtype=np.float64)["factors"]
    expected = [float(eval(expression, MODULES | {"np": np})) for expression in expressions]
    np.testing.assert_allclose(results, [expected] * 2, rtol=1e-15)


@pytest.mark.parametrize(
    "statements",
    [
        "def f(d):\n    d |= {'a': 1}\nd = {}\nf(d)\nn = len(d)",
        "def f(s):\n    s |= {1, 2}\ns = set()\nf(s)\nn = len(s)",
        "def f(x):\n    x *= 2\nx = [1]\nf(x)\nn = len(x)",
        "def f(x):\n    x += (2, 3)\nx = [1]\nf(x)\nn = len(x)",
        "try:\n    n = float('one')\nexcept ValueError:\n    n = 7",
        "try:\n    try:\n        [][1]\n    except IndexError:\n        raise\nexcept LookupError:\n    n = 7",
        "try:\n    try:\n        {}['a']\n    except KeyError as e:\n        raise e\nexcept KeyError:\n    n = 7",
        "def f(a, b=2):\n    return a * b\ntry:\n    n = f(1, a=3)\nexcept TypeError:\n    n = 7",
        "def f(a, /, **more):\n    return a + more['a']\nn = f(1, a=3)",
        "from numpy import *\nn = r_[1, 2][1]",
        "it = iter([1, 2, 3])\nn = (2 in it) + next(it)",
        "it = (x for x in [1, 2, 5])\nn = 10 * any(x > 1 for x in it)\nn += any(map(abs, [0, 0]))",
        "it = iter([0, 3, 4])\nn = any(it) + sum(it)",
        "class A:\n    def f(self):\n        return 1\nclass B:\n    def f(self):\n        return 2\nclass C(A):\n    pass\n"
        "class D(C, B):\n    pass\nn = D().f()",
        "class A:\n    def f(self):\n        return 1\nclass B(A):\n    def f(self):\n        return 10 + super().f()\n"
        "class C(A):\n    def f(self):\n        return 100 + super().f()\nclass D(B, C):\n    pass\nn = D().f()",
        "class A:\n    def __init__(self):\n        super().__init__()\n        self.n = 3\nn = A().n",
        "class A:\n    @classmethod\n    def f(cls):\n        return 1\nclass B(A):\n    @classmethod\n    def f(cls):\n"
        "        return 10 + super().f()\nn = B.f()",
        "it = iter([1, 2])\nn = (it is iter(it)) + next(it)",
        "try:\n    n = len(iter([1]))\nexcept TypeError:\n    n = 7",
        "try:\n    n = iter([1])[0]\nexcept TypeError:\n    n = 7",
        "try:\n    n = f'{[1]:.1f}'\nexcept TypeError:\n    n = 7",
        "try:\n    n = {1} < [1]\nexcept TypeError:\n    n = 7",
        "import numpy as np\nn = len({f'{v:.1f}': v for v in np.array([0.5, 1.5])}) + len(f'{np.mean([1, 2]):.1f}')",
        "import numpy as np\nn = len([0] * round(np.float64(1.6))) + [5, 6, 7][round(np.float64(1.2))] + len(str(round(np.float64(2.5))))",
        "from dataclasses import dataclass, field\n@dataclass\nclass A:\n    x: list = field(default_factory=list)\n"
        "a, b = A(), A()\na.x.append(1)\nn = len(b.x)",
    ],
)
def test_statements_have_their_effect_in_python(statements):
    names = {}
    exec(statements, names)
    graph = read(phi_source(f"{statements}\nreturn [observation[:, :1] * 0 + n]"), 17, 6)
    inputs = {"observation": np.ones((1, 17)), "action": np.ones((1, 6))}
    assert evaluate(graph, inputs)["factors"] == names["n"]


@pytest.mark.parametrize(
    "statement",
    [
        "n = ord('a')", "n = pow(2, 5, 7)", "n = np.sum([])", "n = complex(1, 2).real", "n = int('ff', 16)", "n = hash(3)",
        "l[0:2] = [5]", "n = len(f'{np.ones(2):.1f}')", "n = getattr([], '__len__', 3)",
        "l[0:1] += [5]", "n = list({3, 10, 17, 24, 31})[0]", "n = next(iter([]))", "n = isinstance(map(abs, []), filter)",
        "n = len('9' * 2000) + int('9' * 2000)",
    ],
)  # fmt: skip
def test_what_is_missing_cannot_be_caught(statement):
    """Python would carry out the statement, and never reach the handler."""
    body = f"l, n = [1, 2, 3], 0\ntry:\n    {statement}\nexcept Exception:\n    n = 9\nreturn [observation[:, :1] * n]"
    with pytest.raises(RefusedError, match=r"E-(PYTHON|NUMPY|COST|ATTRIBUTE) line 5"):
        read("import numpy as np\n" + phi_source(body), 17, 6)
