"""The functions of Python that a program can call. Importing a module registers its functions."""

from lare_rl.phi.python_functions import iterables, numbers, types  # noqa: F401
from lare_rl.phi.python_functions.types import ERRORS
from lare_rl.phi.runtime import BUILTINS

__all__ = ["BUILTINS", "ERRORS"]
