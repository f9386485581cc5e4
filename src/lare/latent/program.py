"""From a source that the gate has passed to a function: every name bound to what `language` lists, every loop counted.

The program is simplified (`simplify.py`) and rewritten into the body of one function (`rewrite.py`), which is run anew at each
call, so that nothing that a call leaves behind reaches the next one. Its names are bound to Python's and NumPy's functions,
guarded (`guards.py`), and to nothing that leads further. Loops, comprehensions and calls consume fuel.
"""

import ast
import builtins
import functools
import math
import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from lare.latent.guards import (
    FUEL,
    OPERATORS,
    array_only,
    at_once,
    bounded,
    dtype_of,
    extend,
    few,
    guarded,
    numbers,
    of_few,
    only_numbers,
    rounded,
    size,
    total,
)
from lare.latent.language import BUILTINS, CONSTANTS, DOTTED
from lare.latent.rewrite import CALLED_TYPES, Rewrite
from lare.latent.simplify import simplified

FILE = "latent_function.py"
"""What tracebacks call the program."""


class OutOfFuel(Exception):
    """The program made more turns than it may."""


class Program:
    """A compiled program. `steps` is how much fuel the last call took."""

    def __init__(self, source: str, functions: Mapping[str, Any] | None = None):
        """`functions` replaces what dotted names mean, for a call that is to be watched.

        Raises:
            SyntaxError: what passed the gate does not compile (as `return` outside of a function).
        """
        tree = ast.fix_missing_locations(Rewrite().program(simplified(ast.parse(source))))
        names = {**namespace(), **(functions or {}), "$burn": self.burn, "$range": self.range}
        exec(compile(tree, FILE, "exec", dont_inherit=True), names)
        self.make: Callable[[], Callable[[np.ndarray, np.ndarray], Any]] = names["$program"]
        self.steps = 0

    def __call__(self, observation: np.ndarray, action: np.ndarray) -> Any:
        self.steps = 0
        return self.make()(observation, action)

    def burn(self) -> bool:
        self.steps += 1
        if self.steps > FUEL:
            raise OutOfFuel(f"more than {FUEL} turns of loops and calls")
        return True

    def range(self, *limits: int) -> range:
        return bounded(builtins.range(*limits))


def namespace() -> dict[str, Any]:
    """Everything that a program can name, and nothing that leads further."""
    return dict(everything())


@functools.cache
def everything() -> dict[str, Any]:
    names: dict[str, Any] = {name: resolve(name) for name in DOTTED.keys() | CONSTANTS | {"numpy.errstate"}}
    names |= {
        name: only_numbers(names[name], name) for name in DOTTED if name.startswith("numpy.") and name not in CONSTANTS
    }
    names |= {f"{name}()": only_numbers(names[name], name) for name in CALLED_TYPES}
    names |= {name: getattr(builtins, name) for name in BUILTINS if name != "range"}  # which counts its turns
    for name, (plain, in_place) in OPERATORS.items():
        names |= {f"${name}": guarded(name, plain), f"$i{name}": guarded(name, in_place)}
    names |= {
        "$list": list,
        "$slice": slice,
        "$array": array_only,
        "$dtype": dtype_of,
        "$numbers": numbers,
        "$extend": extend,
        "$few": few,
        "$size": size,
        "round": rounded,
        "sum": total,
    }
    names |= {name: at_once(getattr(builtins, name)) for name in ("enumerate", "reversed", "zip")}
    names |= {name: of_few(getattr(builtins, name)) for name in "all any dict list max min sorted tuple".split()}
    # NumPy imports parts of itself through its caller's __import__, which no program can name.
    return {**names, "__builtins__": {"__import__": already_loaded}}


def resolve(name: str) -> Any:
    """What a dotted name of the language means."""
    module, *parts = name.split(".")
    value: Any = {"numpy": np, "math": math}[module]
    for part in parts:
        value = getattr(value, part)
    return value


def already_loaded(name: str, *rest: Any) -> Any:
    if name.partition(".")[0] == "numpy" and name in sys.modules:
        return sys.modules[name]
    raise ImportError(name)
