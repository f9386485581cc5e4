"""The static gate: every message it can give, every name it knows, and programs made to slip through."""

import ast
import builtins
import contextlib
import io
import json
import keyword
import math
import types
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lare.latent.language import allowed
from lare.latent.language.gate import inspect
from lare.latent.language.program import Program
from toys import phi

CASES = json.loads(Path(__file__).parents[1].joinpath("cases.json").read_text(encoding="utf-8"))
BENIGN = {case["name"]: case["code"] for case in CASES["benign"]}

SOUND = phi("return [action]")
DTYPES = "a dtype must be one of np.bool_, np.float32, np.float64, np.int32, np.int64"
WITH = "with is available only as `with np.errstate(divide='ignore')` and the like"
IMPORTS = "only `import numpy as np` and `import math` are available"
LONG_NAME = "write `import numpy as np` and the function's full name"
PLAIN_WORD = "is no plain word: letters, digits, spaces, _ and - only"
IDENTITY = "is and is not stand beside None, True or False only: use =="
NAMED_LAMBDA = "a lambda must be given a name, and be called by it: name = lambda ..."


def said(source: str) -> list[str]:
    return [str(problem) for problem in inspect(source)]


# --- every message ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "messages"),
    [
        # Before the parser sees it
        ("#" * 20_001, ["E-SIZE line 1: the program has 20001 bytes; at most 20000 are accepted"]),
        ("# " + "ä" * 10_000, ["E-SIZE line 1: the program has 20002 bytes; at most 20000 are accepted"]),
        (f"x = 1\ny = {'(' * 41}1{')' * 41}", ["E-SIZE line 2: brackets are nested more than 40 deep"]),
        (f"x = 1\ny = {'-' * 12}1", ["E-SIZE line 2: a chain of operators is too long"]),
        (f"y = {'+~' * 6}1", ["E-SIZE line 1: a chain of operators is too long"]),
        (f"y = {'not ' * 12}1", ["E-SIZE line 1: a chain of operators is too long"]),
        (f"y = {'lambda: ' * 12}1", ["E-SIZE line 1: a chain of operators is too long"]),
        # The parser
        ("x = 1\ndef f(:\n    pass", ["E-SYNTAX line 2: invalid syntax"]),
        ("x = 1\nx = (1,\n", ["E-SYNTAX line 2: '(' was never closed"]),
        ("x = 1\n  y = 2", ["E-SYNTAX line 2: unexpected indent"]),
        (
            "x = '\udc80'",
            ["E-SYNTAX line 1: there are characters that are no text (surrogates)"],
        ),
        (f"y = {' + '.join('x' * 120)}", ["E-SIZE line 1: the expressions are nested more than 100 deep"]),
        (f"y = x{'.T' * 120}", ["E-SIZE line 1: the expressions are nested more than 100 deep"]),
        # The module
        ("", ["E-DEFINITION line 1: there is no function evaluation_func(observation, action)"]),
        (
            "def reward(observation, action):\n    return [action]",
            ["E-DEFINITION line 1: there is no function evaluation_func(observation, action)"],
        ),
        (
            "evaluation_func = lambda observation, action: [action]",
            [
                "E-DEFINITION line 1: evaluation_func must be a function made by def",
                "E-DEFINITION line 1: there is no function evaluation_func(observation, action)",
            ],
        ),
        (
            "x = 1\nevaluation_func = 3",
            [
                "E-DEFINITION line 1: there is no function evaluation_func(observation, action)",
                "E-DEFINITION line 2: evaluation_func must be a function made by def",
            ],
        ),
        *[
            (
                f"x = 1\ndef evaluation_func({arguments}):\n    return []",
                ["E-DEFINITION line 2: evaluation_func must take exactly two arguments, observation and action"],
            )
            for arguments in ("", "observation", "o, a, b", "o, a, b=1", "o, *, a")
        ],
        (SOUND + "\n" + SOUND, ["E-DEFINITION line 3: evaluation_func is defined twice"]),
        (phi("f = lambda x: x\nf = lambda x: -x\nreturn [f(action)]"), ["E-DEFINITION line 3: f is defined twice"]),
        *[
            (
                f"{SOUND}\n{statement}",
                ["E-MODULE line 3: only imports, functions and constants may stand outside of functions"],
            )
            for statement in ("for i in [1]: x = i", "if True: x = 1", "x += 1", "evaluation_func(1, 2)", "pass", "return 1")
        ],
        # Imports
        (f"import os\n{SOUND}", [f"E-IMPORT line 1: import os: {IMPORTS}"]),
        (f"import math, sys\n{SOUND}", [f"E-IMPORT line 1: import sys: {IMPORTS}"]),
        (f"import os as np\n{SOUND}", [f"E-IMPORT line 1: import os: {IMPORTS}"]),
        (f"import math as np\n{SOUND}", [f"E-IMPORT line 1: import math: {IMPORTS}"]),
        (f"import numpy as n\n{SOUND}", [f"E-IMPORT line 1: import numpy: {IMPORTS}"]),
        (f"import numpy.linalg\n{SOUND}", [f"E-IMPORT line 1: import numpy.linalg: {IMPORTS}"]),
        (f"from os import path\n{SOUND}", [f"E-IMPORT line 1: from os import: {LONG_NAME}"]),
        (f"from numpy import *\n{SOUND}", [f"E-IMPORT line 1: from numpy import: {LONG_NAME}"]),
        (f"from . import x\n{SOUND}", [f"E-IMPORT line 1: from . import: {LONG_NAME}"]),
        (f"from .typing import List\n{SOUND}", [f"E-IMPORT line 1: from .typing import: {LONG_NAME}"]),
        (f"from typing import List as np\n{SOUND}", [f"E-IMPORT line 1: from typing import: {LONG_NAME}"]),
        (
            f"from typing import IO\n{SOUND}",
            [
                "E-IMPORT line 1: from typing import: "
                "only Any, Dict, Iterable, List, NamedTuple, Optional, Sequence, Tuple, Union"
            ],
        ),
        (
            f"from __future__ import braces\n{SOUND}",
            [
                "E-IMPORT line 1: from __future__ import: "
                "only absolute_import, annotations, division, print_function, unicode_literals"
            ],
        ),
        # Constructs
        *[
            (phi(f"x = [1]\n{statement}\nreturn [action]"), [f"E-CONSTRUCT line 3: {name} is not available"])
            for statement, name in (
                ("while True: pass", "while"),
                ("try: pass\nfinally: pass", "try"),
                ("raise ValueError", "raise"),
                                ("class A: pass", "class"),
                ("global y", "global"),
                ("nonlocal y", "nonlocal"),
                ("del x", "del"),
                ("y = f'{x}'", "an f-string"),
                                ("match x:\n    case _: pass", "match"),
                ("yield x", "yield"),
                ("yield from x", "yield"),
                ("await x", "await"),
                ("async def f(): pass", "async"),
                ("async for y in x: pass", "async"),
                ("async with x: pass", "async"),
                ("y = [z async for z in x]", "async"),
                ("y = {1}", "a set"),
                ("y = {z for z in x}", "a set"),
                ("y = x[0] << 2", "the operator LShift"),
                ("x[0] >>= 2", "the operator RShift"),
            )
        ],
        (phi("@evaluation_func\ndef f(): pass\nreturn [action]"), ["E-CONSTRUCT line 3: a decorator is not available"]),
        (phi("def f(*x): pass\nreturn [action]"), ["E-CONSTRUCT line 2: * in a function's head"]),
        (phi("f = lambda **x: 1\nreturn [action]"), ["E-CONSTRUCT line 2: * in a function's head"]),
        (phi("x = {**{1: 2}}\nreturn [action]"), ["E-CONSTRUCT line 2: ** in a dictionary is not available"]),
        (phi("x: open('x') = 1\nreturn [action]"), ["E-CONSTRUCT line 2: an annotation must be a plain type"]),
        (phi("def f(x: (lambda: 1)): pass\nreturn [action]"), ["E-CONSTRUCT line 2: an annotation must be a plain type"]),
        (phi("def f() -> open('x'): pass\nreturn [action]"), ["E-CONSTRUCT line 2: an annotation must be a plain type"]),
        *[
            (phi(f"with {context}:\n    pass\nreturn [action]"), [f"E-CONSTRUCT line 2: {WITH}"])
            for context in (
                "action",
                "open('x')",
                "np.errstate",
                "np.errstate('ignore')",
                "np.errstate(call='ignore')",
                "np.errstate(divide='print')",
                "np.errstate(divide=action)",
                "np.errstate(**{})",
                "np.errstate(divide='ignore') as e",
                "np.errstate(divide='ignore'), np.errstate(over='ignore')",
            )
        ],
        # Names
        (phi("return [x]"), ["E-NAME line 2: x is not defined"]),
        (phi("distance = 1\nreturn [distanse]"), ["E-NAME line 3: distanse is not defined; did you mean distance?"]),
        (phi("return [print]"), ["E-NAME line 2: print is not defined; write nothing: the function only returns its factors"]),
        (phi("return [__builtins__]"), ["E-NAME line 2: __builtins__ is not defined"]),
        (phi("__x = 1\nreturn [action]"), ["E-NAME line 2: __x: names must not begin with two underscores"]),
        (phi("f = lambda __x: 1\nreturn [action]"), ["E-NAME line 2: __x: names must not begin with two underscores"]),
        (phi("np = 1\nreturn [action]"), ["E-DEFINITION line 2: np has a meaning already; choose another name"]),
        (phi("def len(): pass\nreturn [action]"), ["E-DEFINITION line 2: len has a meaning already; choose another name"]),
        (
            phi("return [[action for range in [1]][0]]"),
            ["E-DEFINITION line 2: range has a meaning already; choose another name"],
        ),
        (
            phi("def f(x): return x\nf = 1\nreturn [f(action)]"),
            ["E-DEFINITION line 3: f is the name of a function"],
        ),
        (
            phi("def f(x): return x\ndef g(f): return 1\nreturn [f(action)]"),
            ["E-DEFINITION line 3: f is the name of a function"],
        ),
        (
            phi("x = np\nreturn [action]"),
            ["E-VALUE line 2: np is not a value: write the full name of a function, like np.abs"],
        ),
        (phi("x = evaluation_func\nreturn [action]"), ["E-VALUE line 2: evaluation_func is a function, and can only be called"]),
        (phi("x = len\nreturn [action]"), ["E-VALUE line 2: len is a function, and can only be called"]),
        (phi("x = np.linalg.norm\nreturn [action]"), ["E-VALUE line 2: np.linalg.norm is a function, and can only be called"]),
        (phi("x = action.sum\nreturn [action]"), ["E-VALUE line 2: .sum is a method, and can only be called"]),
        (phi("x = np.finfo(np.float32).sum\nreturn [x]"), ["E-VALUE line 2: .sum is a method, and can only be called"]),
        # Constants
        (phi(f"x = '{'a' * 99}'\nreturn [action]"), [f"E-STRING line 2: the string '{'a' * 30}' {PLAIN_WORD}"]),
        (
            phi("x = {'a{}': 1}\nreturn [action]"),
            [f"E-STRING line 2: the string 'a{{}}' {PLAIN_WORD}"],
        ),
        (phi("x = np.einsum('i->j;', action)\nreturn [x]"), ["E-STRING line 2: np.einsum takes no string here: 'i->j;'"]),
        (phi("x = np.einsum(action, action)\nreturn [x]"), ["E-STRING line 2: the pattern of np.einsum must be written out"]),
        (
            phi("x = np.pad(action, 1, mode='empty')\nreturn [x]"),
            ["E-STRING line 2: mode must be written out: one of constant, edge, reflect, symmetric, wrap"],
        ),
        (phi("x = 2j\nreturn [action]"), ["E-NUMBER line 2: 2j is not a real number"]),
        (phi("x = b'abc'\nreturn [action]"), ["E-NUMBER line 2: b'abc' is not a real number"]),
        (phi(f"x = {2**63 + 1}\nreturn [action]"), ["E-NUMBER line 2: an integer is larger than 2**63"]),
        (
            phi("x = 9 ** 9 ** 9\nreturn [action]"),
            ["E-NUMBER line 2: a power of a power of integers has no bound: make one a float"],
        ),
        # Attributes
        (phi("x = action.base\nreturn [x]"), ["E-ATTRIBUTE line 2: .base is not available"]),
        (phi("x = np.finfo(np.float32).machep\nreturn [x]"), ["E-ATTRIBUTE line 2: .machep is not available"]),
        (phi("action.sort()\nreturn [action]"), ["E-ATTRIBUTE line 2: .sort() is not available"]),
        (phi("x = [].T()\nreturn [action]"), ["E-ATTRIBUTE line 2: .T() is not available"]),
        (phi("action.shape = 3\nreturn [action]"), ["E-STATE line 2: .shape cannot be assigned"]),
        (phi("np.pi = 3\nreturn [action]"), ["E-STATE line 2: .pi cannot be assigned"]),
        # Functions of NumPy and math
        *[
            (phi(f"return [np.{name}(action)]"), [f"E-NUMPY line 2: np.{name} is not available: {why}"])
            for name, why in (
                ("genfromtxt", "it reads or writes files"),
                ("random.normal", "it depends on chance"),
                ("empty_like", "it returns memory that nobody has written; write np.zeros_like"),
                ("unique", "the shape of its result depends on values"),
                ("fromfunction", "it calls Python for each element"),
                ("sigmoid", "there is no such function; write 1 / (1 + np.exp(-np.clip(x, -50, 50)))"),
                ("aranje", "there is no such function; did you mean np.arange?"),
                ("sum.at", "there is no such function; did you mean np.sum?"),
                ("float", "there is no such function; did you mean np.float64?"),
            )
        ],
        *[
            (phi(f"return [np.{name}(action)]"), [f"E-NUMPY line 2: np.{name} is not allowed{instead}"])
            for name, instead in (
                ("bincount", ""),
                ("linalg.svd", ""),
                ("linalg.inv", "; write np.linalg.norm and explicit formulas"),
                ("bool", "; write np.bool_"),
                ("add.accumulate", "; write np.cumsum"),
                ("f2py", ""),
                ("f2py.os.system", ""),
                ("fft.fft", ""),
                ("__dict__", ""),
                ("sum.__globals__", ""),
            )
        ],
        (phi("x = np.euler_gamma\nreturn [action]"), ["E-NUMPY line 2: np.euler_gamma is not allowed"]),
        (phi("return [math.pow(2, 3)]"), ["E-MATH line 2: math.pow is not allowed; write the operator **"]),
        (phi("return [math.gcd(2, 3)]"), ["E-MATH line 2: math.gcd is not allowed"]),
        (phi("return [math.two(1)]"), ["E-MATH line 2: math.two is not available: there is no such function"]),
        (phi("return [math.sigmoid(1)]"), ["E-MATH line 2: math.sigmoid is not available: there is no such function"]),
        # Calls
        (phi("return [max(*action)]"), ["E-CALL line 2: * and ** in a call are not available"]),
        (phi("return [max(**{})]"), ["E-CALL line 2: * and ** in a call are not available"]),
        (phi("x = 1\nreturn [x(1)]"), ["E-CALL line 3: x is a value, and cannot be called"]),
        (phi("return [observation(1)]"), ["E-CALL line 2: observation is a value, and cannot be called"]),
        (phi("return [getattr(1)]"), ["E-CALL line 2: getattr is not a function that is available"]),
        (phi("return [pow(2, 3)]"), ["E-CALL line 2: pow is not a function that is available; write the operator **"]),
        (phi("return [sort(1)]"), ["E-CALL line 2: sort is not a function that is available; did you mean sorted?"]),
        *[
            (
                phi(call),
                [
                    *(f"E-CALL line 2: {problem}" for problem in (why, "open is not a function that is available")),
                    "E-NUMPY line 2: np.load is not available: it reads or writes files",
                ],
            )
            for why, calls in {
                "only a function that has a name can be called": (
                    "return np.abs(np.load(1))(open(2))",
                    "return [1][np.load(1)](open(2))",
                    "return (lambda x: np.load(x))(open(2))",
                ),
                "* and ** in a call are not available": ("return max(*np.load(1), open(2))", "return max(np.load(1), **open(2))"),
            }.items()
            for call in calls
        ],
        (phi("return [[1][0](1)]"), ["E-CALL line 2: only a function that has a name can be called"]),
        (phi("return [(lambda: 1)()]"), ["E-CALL line 2: only a function that has a name can be called"]),
        (phi("return [lambda: 1]"), [f"E-CALL line 2: {NAMED_LAMBDA}"]),
        (
            phi("f = g = lambda: 1\nreturn [action]"),
            [
                f"E-CALL line 2: {NAMED_LAMBDA}",
                "E-DEFINITION line 2: f is the name of a function",
                "E-DEFINITION line 2: g is the name of a function",
            ],
        ),
        (phi("f: int = lambda: 1\nreturn [action]"), [f"E-CALL line 2: {NAMED_LAMBDA}"]),
        (phi("return [np.abs()]"), ["E-CALL line 2: np.abs takes 1 arguments by position, not 0"]),
        (phi("return [np.add(1, 2, action)]"), ["E-CALL line 2: np.add takes 2 arguments by position, not 3"]),
        (phi("return [np.where(action)]"), ["E-CALL line 2: np.where takes 3 arguments by position, not 1"]),
        (phi("return [np.sum(1, 2, 3)]"), ["E-CALL line 2: np.sum takes 1 to 2 arguments by position, not 3"]),
        (phi("return [action.astype()]"), ["E-CALL line 2: astype takes 1 arguments by position, not 0"]),
        (phi("return [len()]"), ["E-CALL line 2: len takes 1 arguments by position, not 0"]),
        (phi("return [math.log(1, 2, 3)]"), ["E-CALL line 2: math.log takes 1 to 2 arguments by position, not 3"]),
        (
            phi("return [np.finfo()]"),
            ["E-CALL line 2: np.finfo takes 1 arguments by position, not 0", f"E-DTYPE line 2: {DTYPES}"],
        ),
        # Keywords
        (phi("return [np.sum(action, order=1)]"), ["E-KEYWORD line 2: np.sum has no keyword order here"]),
        (phi("return [max([1], key=1)]"), ["E-KEYWORD line 2: max has no keyword key here"]),
        (phi("return [sorted([1], reverse=True)]"), ["E-KEYWORD line 2: sorted has no keyword reverse here"]),
        (phi("return [action.sum(out=1)]"), ["E-KEYWORD line 2: sum has no keyword out here"]),
        (
            phi("return [np.sqrt(action, where=action > 0)]"),
            ["E-KEYWORD line 2: np.sqrt with where= needs out= too: memory that nobody has written"],
        ),
        # Types
        (
            phi("return [action.astype('i2')]"),
            [f"E-DTYPE line 2: {DTYPES}", "E-STRING line 2: astype takes no string here: 'i2'"],
        ),
        (phi("return [np.zeros(3, dtype=object)]"), [f"E-DTYPE line 2: {DTYPES}", "E-NAME line 2: object is not defined"]),
        (phi("return [np.zeros(3, dtype=None)]"), [f"E-DTYPE line 2: {DTYPES}"]),
        (phi("return [np.array([1], [1])]"), [f"E-DTYPE line 2: {DTYPES}"]),
        (phi("return [np.full(3, 1, 2)]"), [f"E-DTYPE line 2: {DTYPES}"]),
        (phi("return [np.finfo(3)]"), [f"E-DTYPE line 2: {DTYPES}"]),
        # What outlives a call, and what is not one's own
        (phi("def f(x=[]): pass\nreturn [action]"), ["E-STATE line 2: a default must be a number, a plain word or None"]),
        (phi("def f(*, x=1 + 1): pass\nreturn [action]"), ["E-STATE line 2: a default must be a number, a plain word or None"]),
        (phi("f = lambda x='%': x\nreturn [action]"), ["E-STATE line 2: a default must be a number, a plain word or None"]),
        *[
            (
                f"x = [1]\n{phi(change)}",
                ["E-STATE line 3: x belongs to another place, and cannot be changed here"],
            )
            for change in ("x[0] = 2", "x.append(2)", "x[0] += 1", "x[0][1:2] = 2", "x.copy().extend(x)", "x.pop().insert(0, 1)")
        ],
        (
            phi("x = [1]\ndef f():\n    x.append(1)\nreturn [action]"),
            ["E-STATE line 4: x belongs to another place, and cannot be changed here"],
        ),
        *[
            (phi(change), ["E-INPUT line 2: this writes into the input action: copy it first"])
            for change in ("action[0] = 1", "action[:, 0] *= 2", "action.T[0] = 1", "action.reshape(-1)[0] = 1", "action.append(1)")
        ],
        (phi("observation += 1"), ["E-INPUT line 2: `observation ...=` writes into the input: copy it first"]),
        *[
            (phi(f"x = np.bool_(1)\nreturn [action * ({test})]"), [f"E-CONSTRUCT line 3: {IDENTITY}"])
            for test in ("(action.sum() > 0) is x", "x is not x", "None is x is x", "1 is x")
        ],
        # Recursion
        (
            phi("return evaluation_func(observation, action)"),
            ["E-RECURSION line 1: evaluation_func calls itself, directly or through others"],
        ),
        (
            f"def f(x): return g(x)\ndef g(x): return f(x)\n{SOUND}",
            [
                "E-RECURSION line 1: f calls itself, directly or through others",
                "E-RECURSION line 2: g calls itself, directly or through others",
            ],
        ),
        # An annotation is not evaluated, and calls nothing
        *[
            (f"def f{head}:\n    {body}\n{SOUND}", [f"E-CONSTRUCT line {line}: an annotation must be a plain type"])
            for head, body, line in (("() -> f()", "pass", 1), ("(x: f())", "pass", 1), ("()", "x: f() = 1", 2))
        ],
        (phi("f = lambda x: f(x)\nreturn [f(action)]"), ["E-RECURSION line 2: f calls itself, directly or through others"]),
    ],
)  # fmt: skip
def test_every_message(source, messages):
    assert said(source) == messages


def test_everything_is_said_at_once_in_the_order_of_lines():
    source = """import os
np.save('x', 1)
def evaluation_func(observation, action):
    while True:
        pass
    try:
        x = open('x')
    except* ValueError:
        pass
    y = lambda z=[]: np.load(z); print(y)
    return [action.base, np.clamp(missing), f'{x}', 1j]
"""
    assert said(source) == [
        f"E-IMPORT line 1: import os: {IMPORTS}",
        "E-MODULE line 2: only imports, functions and constants may stand outside of functions",
        "E-CONSTRUCT line 4: while is not available",
        "E-CONSTRUCT line 6: TryStar is not available",
        "E-CALL line 7: open is not a function that is available",
        "E-CALL line 10: print is not a function that is available; write nothing: the function only returns its factors",
        "E-NUMPY line 10: np.load is not available: it reads or writes files",
        "E-STATE line 10: a default must be a number, a plain word or None",
        "E-VALUE line 10: y is a function, and can only be called",
        "E-ATTRIBUTE line 11: .base is not available",
        "E-CONSTRUCT line 11: an f-string is not available",
        "E-NAME line 11: missing is not defined",
        "E-NUMBER line 11: 1j is not a real number",
        "E-NUMPY line 11: np.clamp is not available: there is no such function; write np.clip",
    ]


@pytest.mark.parametrize(
    "statement",
    [
        "while np.load(1): x = open(2)",
        "while True:\n    x = np.load(1)\nelse: x = open(2)",
        "try: x = np.load(1)\nexcept ValueError as e: x = [e, open(2)]",
        "try: x = np.load(1)\nexcept* ValueError as e: x = [e, open(2)]",
        "try: x = np.load(1)\nfinally: x = open(2)",
        "x = {np.load(1), open(2)}",
        "x = {np.load(y) for y in open(2)}",
        "x = yield np.load(1), open(2)",
    ],
)
def test_what_stands_in_something_refused_is_looked_at_too(statement):
    codes = [problem.code for problem in inspect(phi(f"{statement}\nreturn [x]"))]
    assert sorted(set(codes)) == ["E-CALL", "E-CONSTRUCT", "E-NUMPY"]


def test_the_same_is_not_said_twice_of_a_line():
    assert said(phi("return [np.load(1), np.load(2)]")) == [
        "E-NUMPY line 2: np.load is not available: it reads or writes files"
    ]


# --- what it lets through --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "source",
    [
        # Right beside what is refused above
        f"{'#' * (19_999 - len(SOUND))}\n{SOUND}",
        phi(f"return [{'(' * 39}action{')' * 39}]"),
        phi(f"return [{'-' * 11}action]"),
        phi(f"x = {2**63}\nreturn [(action ** 2) ** x]"),
        "'''Words.'''\n" + phi("'''Words {0.__class__}.'''\nreturn [action]"),
        "import numpy as np, math\nimport numpy\n" + phi("import math\nreturn [numpy.abs(action) * np.pi * math.tau]"),
        "from __future__ import annotations, division\nfrom typing import Dict, List\n" + SOUND,
        "def evaluation_func(o: np.ndarray, /, a: 'np.ndarray' = None) -> tuple[int, ...] | None:\n    return [a]",
        "X = np.array([1.0, 2.0])\nY, Z = X * 2, [1, 2]\nZ[0] = 3\n" + phi("return [action * X[0] * Z[0]]"),
        phi("x: int\nx: int = 1\nreturn [action * x]"),
        phi("x = {'a': 1, 'b c': 2}\nreturn [action * x['a'] * x.get('b c', 0) * ('d' in x) * ('d' not in x)]"),
        phi("x = {k: action for k in range(2)}\nreturn [x[k] for k in x]"),
        phi("def f(x, y=-1.5, z=(1, -2), *, w=None, v=True): return x\nreturn [f(action, w=3)]"),
        phi("f = lambda x, k=2.0: x * k\nreturn [f(action), f(action, 1.0)]"),
        phi("def f(x):\n    def g(y): return y\n    return g(x)\nreturn [f(action)]"),
        phi("x = [1]\nx.append(2)\nx[0] += 1\nx.pop()\nreturn [action * x[0]]"),
        phi("def f(x):\n    x.append(1)\n    return x\nreturn [action * len(f([]))]"),
        phi("action = action.copy()\naction[0] = 1\naction += 1\nreturn [action]"),
        phi("x = np.divide(action, 2, out=np.zeros_like(action), where=action > 0)\nreturn [x]"),
        phi("return [action.sum(1, keepdims=True, where=action > 0)]"),
        phi("return [action.astype(float), action.astype('f4'), action.astype(observation.dtype), np.zeros(3, 'int')]"),
        phi("x = np.finfo(np.float32)\nreturn [action * np.finfo(np.float64).max * x.eps * np.finfo('f4').tiny]"),
        phi("return [np.einsum('ij, ij -> i', action, action)[..., None], np.pad(action, 1, 'edge')]"),
        phi("return [np.einsum('...i,...i->...', action, action)[:, None]]"),
        phi("x = None\nreturn [action if x is None else x, action * (True is not x)]"),
        phi("with np.errstate(divide='ignore', over='ignore'):\n    return [1 / action]"),
        phi("for i, (x, y) in enumerate(zip([1], [2])):\n    if i: continue\n    break\nelse:\n    pass\nreturn [action]"),
        phi("return [action if 0 < action.shape[0] <= 3 and not None else ~(action > 0) & (action < 1)]"),
        phi("return [[x * y for x in [1] if x for y in [2]][0] * action, sum(x for x in [1]) * action]"),
    ],
)  # fmt: skip
def test_what_is_in_the_language(source):
    assert said(source) == []


@pytest.mark.parametrize("name", BENIGN)
def test_the_benign_programs_are_let_through(name):
    assert said(BENIGN[name]) == []


# --- hostile programs ------------------------------------------------------------------------------------------------

FIRST_CODE = """
from_numpy_import_load E-NUMPY     star_import E-IMPORT                import_time_clock E-IMPORT
import_random E-IMPORT              open_file E-ATTRIBUTE               eval_string E-CALL
compile_string E-CALL               getattr_concat E-CALL               globals_call E-CALL
type_call E-CALL                    exit_call E-CALL                    raise_systemexit E-CONSTRUCT
breakpoint_call E-CALL              id_address E-CALL                   hash_seed E-CALL
function_globals E-NUMPY            builtin_self E-ATTRIBUTE            np_dunder_dict E-CALL
math_loader E-MATH                  str_format_attr E-ATTRIBUTE         str_format_map E-ATTRIBUTE
fstring_attr E-CONSTRUCT            fstring_width_memory E-CONSTRUCT    generator_frame E-ATTRIBUTE
yield_function E-CONSTRUCT          exception_traceback E-CONSTRUCT     attributeerror_obj E-CONSTRUCT
try_swallow E-CONSTRUCT             match_class_pattern E-CONSTRUCT     annotation_exec E-CONSTRUCT
default_arg_exec E-STATE            module_level_call E-MODULE          walrus_rebind_np E-DEFINITION
nfkc_homoglyph E-SYNTAX          kwargs_smuggling E-CALL             starargs_dtype_smuggling E-CALL
attribute_store_np E-STATE          np_load_pickle E-NUMPY              np_fromfile E-NUMPY
np_memmap E-NUMPY                   np_savetxt E-NUMPY                  ndarray_ctypes E-ATTRIBUTE
np_f2py_subprocess E-NUMPY          np_ndarray_ctor E-NUMPY             np_empty E-NUMPY
where_without_out E-KEYWORD         np_frompyfunc E-CALL                np_vectorize E-CALL
np_apply_along_axis E-CALL          np_errstate_callback E-CONSTRUCT    astype_object_code E-DTYPE
np_random_rand E-NUMPY              np_random_seeded E-NUMPY            hallucinated_np_function E-NUMPY
torch_call E-IMPORT                 mutable_default_state E-STATE       global_counter E-CONSTRUCT
module_list_append E-STATE          module_array_store E-STATE          closure_nonlocal E-CONSTRUCT
function_attribute_state E-STATE    mutate_subscript E-INPUT            mutate_augassign E-INPUT
mutate_sort_method E-ATTRIBUTE      mutate_add_at E-NUMPY               mutate_base E-ATTRIBUTE
mutate_flat E-ATTRIBUTE             while_true E-CONSTRUCT              recursion E-RECURSION
power_tower E-NUMBER                huge_int_literal E-NUMBER           nesting_bomb E-SIZE
unary_bomb E-SIZE                   two_definitions E-DEFINITION        float_nan_string E-STRING
lambda_default_exec E-STATE         where_one_argument E-CALL
""".split()
FIRST_CODE = dict(zip(FIRST_CODE[::2], FIRST_CODE[1::2], strict=True))
HOSTILE = {case["name"]: case["code"] for case in CASES["hostile"] if case["gate"] == "static"}


def test_every_hostile_program_has_its_code():
    assert FIRST_CODE.keys() == HOSTILE.keys()


@pytest.mark.parametrize("name", HOSTILE)
def test_the_hostile_programs_are_refused(name):
    assert inspect(HOSTILE[name])[0].code == FIRST_CODE[name]


# What sandboxes made of general Python let through, each in one small program.
CVE = {
    # RestrictedPython: a generator's frame, and from there whatever is below it
    "2023-37271": "g = (g.gi_frame.f_back.f_builtins for x in [1])\nreturn [y for y in g]",
    # RestrictedPython: attributes looked up by str.format
    "2023-41039": "return ['{0.__class__.__mro__[1].__subclasses__}'.format(action)]",
    # numexpr: an expression in a string, evaluated
    "2023-39631": "return [eval('().__class__.__base__.__subclasses__()')]",
    # RestrictedPython: an exception hands out the object that it came from
    "2024-47532": "try:\n    action.nothing\nexcept AttributeError as error:\n    return [error.obj]",
    # RestrictedPython: except* confuses the interpreter about types
    "2025-22153": "try:\n    return [action]\nexcept* ValueError as error:\n    return [error]",
    # asteval: attributes looked up by a format in an f-string
    "2025-24359": "return [f'{action.__class__.__mro__!r:>{10}}']",
    # smolagents: from a module that is allowed to the modules that it uses
    "2025-5120": "return [np.f2py.os.system('true')]",
    # smolagents: attributes with underscores that the list of forbidden ones did not have
    "2025-9959": "return [action.__reduce_ex__(2)[0].__globals__]",
    # smolagents: the same through with, augmented assignment and calls
    "2026-4963-with": "with action.__class__:\n    return [action]",
    "2026-4963-augassign": "action.__class__ += 1\nreturn [action]",
    "2026-4963-call": "return [action.__class__.__call__(action)]",
    # asteval: exceptions that `except Exception` does not catch
    "2026-55244": "raise SystemExit",
    # RestrictedPython: a positional-only argument takes the name of a guard
    "2026-55830": "def f(np, /, range=1): return np\nreturn [f(action)]",
    # RestrictedPython: attributes looked up by string.Formatter
    "2026-76825": "import string\nreturn [string.Formatter().get_field('0.__class__', [action], {})]",
}


@pytest.mark.parametrize("number", CVE)
def test_cve(number):
    ast.parse(phi(CVE[number]))
    codes = {problem.code for problem in inspect(phi(CVE[number]))}
    assert codes - {"E-SYNTAX", "E-SIZE"}


# --- every name there is ---------------------------------------------------------------------------------------------


def refused_lines(lines: list[str], head: str = "def evaluation_func(observation, action):\n") -> set[int]:
    """Which of some statements the gate refuses. Many at a time, since each program takes a while."""
    found, start = set(), 0
    while start < len(lines):
        body = head
        taken = 0
        while start + taken < len(lines) and len(body) + len(lines[start + taken]) < 19_000:
            body += f"    {lines[start + taken]}\n"
            taken += 1
        problems = inspect(body)
        assert all(problem.line > 1 for problem in problems), problems
        found |= {start + problem.line - 2 for problem in problems}
        start += taken
    return found


def names_of_numpy() -> set[str]:
    """What a dotted name can reach in NumPy, whether or not it is meant for users: everything that stands in its modules,
    and each attribute of each type of thing in them, once.
    """
    names, seen = set(np.__all__) | set(vars(np)), set()
    prefixes = {name.split(".")[0] for name in allowed.NUMPY if "." in name}
    for name, value in vars(np).items():
        for inner in dir(value):
            kind = (type(value), inner)
            if isinstance(value, types.ModuleType) or name in prefixes or kind not in seen:
                seen.add(kind)
                names.add(f"{name}.{inner}")
    for name in ("linalg", "random", "fft", "lib", "ma", "char", "core", "testing", "ctypeslib", "f2py"):
        names |= {f"{name}.{inner}" for inner in ("os", "sys", "load", "norm", "inv", "system", "sum.reduce")}
    return {name for name in names if all(map(is_identifier, name.split(".")))}


def is_identifier(part: str) -> bool:
    return part.isidentifier() and not keyword.iskeyword(part)


def call_of(name: str, signature: allowed.Signature) -> str:
    """A call that fits a signature."""
    arguments = ["observation"] * min(max(signature.least, 1), signature.most)
    float32 = ["np.float32"]
    special = {"numpy.einsum": ["'ij->i'", "observation"], "numpy.finfo": float32, "astype": float32}
    return f"{name.replace('numpy.', 'np.')}({', '.join(special.get(name, arguments))})"


def test_every_name_of_numpy_is_on_the_list_or_refused(monkeypatch):
    # Nearly all of the time would go into looking for what might have been meant.
    monkeypatch.setattr("lare.latent.language.expressions.difflib.get_close_matches", lambda *_: [])
    names = sorted(names_of_numpy() | allowed.NUMPY.keys() | allowed.NUMPY_CONSTANTS)
    assert len(names) > 2000
    none = allowed.Signature(1, 1)
    calls = [call_of(f"numpy.{name}", allowed.NUMPY.get(name, none)) for name in names]
    refused = refused_lines(calls)
    assert {name for number, name in enumerate(names) if number not in refused} == set(allowed.NUMPY)
    values = refused_lines([f"x = np.{name}" for name in names])
    passed = {name for number, name in enumerate(names) if number not in values}
    assert passed == allowed.NUMPY_CONSTANTS | allowed.DTYPES


def test_every_name_of_math_is_on_the_list_or_refused():
    names = sorted({*dir(math), "lgamma", "os"})
    none = allowed.Signature(1, 1)
    refused = refused_lines([call_of(f"math.{name}", allowed.MATH.get(name, none)) for name in names])
    assert {name for number, name in enumerate(names) if number not in refused} == set(allowed.MATH)
    values = refused_lines([f"x = math.{name}" for name in names])
    assert {name for number, name in enumerate(names) if number not in values} == allowed.MATH_CONSTANTS


def test_every_builtin_is_on_the_list_or_refused():
    names = sorted(name for name in dir(builtins) if not keyword.iskeyword(name))
    none = allowed.Signature(1, 1)
    refused = refused_lines([call_of(name, allowed.BUILTINS.get(name, none)) for name in names])
    assert {name for number, name in enumerate(names) if number not in refused} == set(allowed.BUILTINS)
    assert refused_lines([f"x = {name}" for name in names]) == set(range(len(names)))


REACHABLE = [
    *(np.zeros(2), np.float32(1), np.bool_(True), np.int64(1), np.dtype("f4"), np.finfo("f4"), np.float32, np.add),
    *(np.zeros(2).flat, np.zeros(2).flags, np.errstate(), np.array(None), np.zeros(1).ctypes),
    *([1], {"a": 1}, {"a": 1}.keys(), {"a": 1}.items(), {"a": 1}.values(), (1,), 1, 1.0, True, "a", None, ..., slice(1)),
    *(range(1), zip([]), enumerate([]), reversed([]), iter([]), iter(()), iter(range(1)), iter(np.zeros(1))),
    *(len, [].append, np.sum, phi, type(phi).__code__, phi.__code__, lambda: 1, (x for x in ()), np, type, object()),
    *(ValueError(), io.StringIO(), types.SimpleNamespace(), AttributeError("a", obj=1)),
]  # fmt: skip
"""A value of each type that a program can have in its hands, and of some that it must not get there."""


def test_every_attribute_of_every_type_is_on_the_lists_or_refused():
    names = sorted({name for value in REACHABLE for name in dir(value)} | {"gi_frame", "tb_frame", "f_back", "obj"})
    assert len(names) > 500
    none = allowed.Signature(1, 1)
    calls = [f"[1].{call_of(name, allowed.METHODS.get(name, none))}" for name in names]
    refused = refused_lines(calls)
    assert {name for number, name in enumerate(names) if number not in refused} == set(allowed.METHODS) & set(names)
    assert set(allowed.METHODS) <= set(names)
    reads = refused_lines([f"x = observation.{name}" for name in names])
    assert {name for number, name in enumerate(names) if number not in reads} == allowed.ATTRIBUTES
    assert refused_lines([f"action[0].{name} = 1" for name in names]) == set(range(len(names)))
    of_finfo = refused_lines([f"x = np.finfo(np.float32).{name}" for name in names])
    passed = {name for number, name in enumerate(names) if number not in of_finfo}
    assert passed == allowed.ATTRIBUTES | {"max", "min"}


def test_nothing_on_the_lists_leads_out():
    everything = {*allowed.NUMPY, *allowed.MATH, *allowed.METHODS, *allowed.ATTRIBUTES, *allowed.BUILTINS}
    for part in {part for name in everything for part in name.split(".")}:
        assert not part.startswith("_")
    # In place, into files, into raw memory, into text, or to a caller's function.
    assert not {part for name in allowed.NUMPY for part in name.split(".")} & set(
        "apply_along_axis apply_over_axes array2string array_repr array_str at copyto ctypeslib empty empty_like f2py "
        "fill_diagonal frombuffer fromfile fromfunction fromiter frompyfunc fromregex fromstring genfromtxt info inv lib "
        "load loadtxt memmap ndarray nonzero piecewise place put putmask random resize save savetxt savez set_printoptions "
        "setbufsize seterr seterrcall show_config testing unique vectorize".split()
    )
    assert not {*allowed.METHODS, *allowed.ATTRIBUTES} & set(
        "base byteswap ctypes data dump dumps fill flags flat format format_map item itemset put resize setfield setflags "
        "sort tobytes tofile tolist view".split()
    )
    assert not {*allowed.BUILTINS} & set(
        "breakpoint compile delattr dir eval exec filter format getattr globals hash help id input iter locals map memoryview "
        "next object open print repr setattr str super type vars".split()
    )
    functions = allowed.DOTTED | allowed.METHODS | allowed.BUILTINS
    assert not {keyword for one in functions.values() for keyword in one.keywords} & set(
        "call casting device extobj func key like order signature subok".split()
    )


# --- texts that nobody wrote -----------------------------------------------------------------------------------------

FIXED = settings(max_examples=100, derandomize=True, deadline=None)
LINES = sorted({line for code in BENIGN.values() for line in code.splitlines() if line.startswith("    ")})
TOKENS = (
    "def evaluation_func ( observation , action ) : [ ] { } = == + - ** * / % @ ~ not lambda x np . abs sum : ; # ' \" \\ "
    "return if else for in with import from as 1 1e999 0x1 1j ... None ''' f' b' := async await match ä ﬀ"
)
WORDS = [*TOKENS.split(), "\n", "\t", "\r", "\f", "\0"]
QUIET = pytest.mark.filterwarnings("ignore::SyntaxWarning", "ignore::DeprecationWarning")


def is_verdict(source: str) -> bool:
    """Whether the gate came to an end, and its problems are lines of the program in their order."""
    problems = inspect(source)
    lines = [problem.line for problem in problems]
    last = len(source.splitlines()) + 2
    return lines == sorted(lines) and all(1 <= line <= last for line in lines)


@QUIET
@FIXED
@given(st.one_of(st.text(max_size=400), st.lists(st.sampled_from(WORDS), max_size=80).map(" ".join)))
def test_any_text_has_a_verdict(text):
    assert is_verdict(text)
    assert is_verdict(phi(text))


@QUIET
@pytest.mark.parametrize(
    "unit",
    [
        *("(", "[{(", "-", "~+", "not ", "not -", "- " * 11 + "x ", "lambda:", "lambda x:", "lambda x=", "x.", "x[", "x("),
        *("x if x else ", "x,", "x+", "x**", "x<", "x and ", "x or ", "x:=", "*", "**", "1", "_", ".", ":", "yield ", "await "),
        *("@x\n", "if x:\n", "elif x: pass\n", "for x in x ", "[x for x in ", "f'{", "'", '"""'),
        *("\\\n", " ", "\t\n", "\r", "\f", "\0"),
    ],
)  # fmt: skip
def test_the_same_again_and_again_has_a_verdict(unit):
    # As long as a program may be: the parser must not crash, and no expression of ours go mad.
    assert is_verdict((unit * 20_000)[:20_000])
    assert is_verdict(phi("x = " + (unit * 20_000)[:19_900]))
    # And where the guard takes it for a comment.
    assert is_verdict(phi("x = '#', " + (unit * 20_000)[:19_900]))


@QUIET
@FIXED
@given(st.sampled_from([*BENIGN.values(), *HOSTILE.values()]), st.data())
def test_a_program_that_breaks_off_has_a_verdict(source, data):
    assert is_verdict(source[: data.draw(st.integers(0, min(len(source), 2000)))])


EXPRESSIONS = [
    *("open('x')", "__import__('os')", "eval('1')", "np.load('x')", "np.random.rand()", "np.f2py", "[np]", "[len]", "().__class__"),
    *("action.ctypes", "action.base", "action.tofile('x')", "action.view(object)", "f'{action}'", "'{}'.format(action)"),
    *("(lambda: 1)()", "(yield)", "(np := 1)", "{1, 2}", "np.abs(*action)", "max(*action)", "math.__loader__", "globals()", "1j"),
    *("np.empty(3)", "np.vectorize(len)", "action.astype('O')", "np.sqrt(action, where=True)", "nobody_defined_this"),
]  # fmt: skip


class Splice(ast.NodeTransformer):
    """Puts an expression in the place of the n-th one of a program's code."""

    def __init__(self, place: int, expression: ast.expr):
        self.left, self.expression = place, expression

    def generic_visit(self, node):
        # Annotations are never evaluated, and may name anything.
        kept = {"annotation", "returns"}
        for name, value in ast.iter_fields(node):
            if name in kept:
                continue
            if isinstance(value, list):
                setattr(node, name, [self.visit(one) if isinstance(one, ast.AST) else one for one in value])
            elif isinstance(value, ast.AST):
                setattr(node, name, self.visit(value))
        return node

    def visit(self, node):
        if isinstance(node, ast.expr) and isinstance(getattr(node, "ctx", ast.Load()), ast.Load):
            self.left -= 1
            if self.left == -1:
                return self.expression
        return self.generic_visit(node)


@FIXED
@given(st.sampled_from(sorted(BENIGN)), st.sampled_from(EXPRESSIONS), st.integers(0, 400))
def test_a_hostile_expression_is_found_wherever_it_stands(name, expression, place):
    tree = ast.parse(BENIGN[name])
    expressions = sum(
        isinstance(node, ast.expr) and isinstance(getattr(node, "ctx", ast.Load()), ast.Load) for node in ast.walk(tree)
    )
    splice = Splice(place % expressions, ast.parse(expression, mode="eval").body)
    source = ast.unparse(ast.fix_missing_locations(splice.visit(tree)))
    if splice.left < 0:
        assert inspect(source), source


def does_no_harm(source: str) -> bool:
    """Whether a program comes to an end if it is let through. It may fail, as any program may."""
    observation = np.linspace(-1, 1, 40).reshape(4, 10)
    observation.setflags(write=False)
    if is_verdict(source) and not inspect(source):
        with np.errstate(all="ignore"), contextlib.suppress(Exception):
            Program(source)(observation, observation[:, :6])
    return True


@QUIET
@FIXED
@given(st.lists(st.sampled_from(LINES), min_size=2, max_size=12))
def test_benign_lines_in_any_order_do_no_harm(lines):
    assert does_no_harm("\n".join(["def evaluation_func(observation, action):", *lines]))


@QUIET
@FIXED
@given(st.sampled_from(sorted(BENIGN)), st.sampled_from(sorted(BENIGN)), st.integers(0, 30), st.integers(0, 30))
def test_benign_programs_crossed_do_no_harm(first, second, upper, lower):
    lines = [*BENIGN[first].splitlines()[:upper], *BENIGN[second].splitlines()[lower:]]
    assert does_no_harm("\n".join(lines))


UNSEEN = "\x1b\x07\x00\x7f\x9b\u202e\u2066\u200b\ufeff\u00ad\u180e\u034f\u3164\ufe0f\u2800\ue000\U000e0041\U0010fffd"


@pytest.mark.parametrize("letter", UNSEEN)
def test_no_letter_that_nobody_sees(letter):
    """Not even in a comment: a person is to read this, in a terminal."""
    source = f"def evaluation_func(o, a):\n    # upright {letter} and calm\n    return [o]\n"
    (problem,) = inspect(source)
    assert str(problem) == f"E-SYNTAX line 2: there is {letter!a}, a character that nobody sees: only text, please"


@pytest.mark.parametrize(
    ("code", "letter", "line"),
    [
        ("\u0430 = 1", "\\u0430", 2),  # the Cyrillic a
        ("x = 1\nx = \u0440hi(x)", "\\u0440", 3),
        ("\U0001d431 = 1", "\\U0001d431", 2),  # a bold x, which Python takes for an x
        ("x = o.\uff33hape", "\\uff33", 2),
        ("ü = 1", "\\xfc", 2),
    ],
)
def test_letters_of_other_scripts_are_for_comments(code, letter, line):
    assert said(phi(f"{code}\nreturn [action]  # ü\n'ü'")) == [
        f"E-SYNTAX line {line}: '{letter}' is no letter of a program: only ASCII stands outside of comments"
    ]


@pytest.mark.parametrize("end", ["\r", "\r\n", "\f\n"])
def test_lines_may_end_as_they_like(end):
    source = "def evaluation_func(o, a):\n    # ü\n    return [o]\n"
    assert inspect(source.replace("\n", end)) == []


@pytest.mark.parametrize("letter", ["\t", "\r\n", "ü", "→", "─", "π", "🙂"])
def test_letters_that_are_welcome_in_comments(letter):
    assert inspect(f"def evaluation_func(o, a):\n    # upright {letter}# and calm\n    return [o]\n") == []
