"""The functions of Python that a program can call."""

from lare_rl.phi.python_functions import iterables, numbers, types
from lare_rl.phi.python_functions.types import ERRORS
from lare_rl.phi.runtime import BUILTINS

__all__ = ["BUILTINS", "ERRORS", "iterables", "numbers", "types"]
