"""NumPy's functions, made of the operations of the graph. Importing a module registers its functions."""

from lare_rl.phi.numpy_functions import creation, elementwise, products, reductions, sequences, shapes, tables  # noqa: F401
from lare_rl.phi.numpy_functions.creation import INDEXED
from lare_rl.phi.numpy_functions.registry import FUNCTIONS, KIND_OF_DTYPE, call_numpy, find_hint
from lare_rl.phi.numpy_functions.tables import Polynomial

__all__ = ["FUNCTIONS", "INDEXED", "KIND_OF_DTYPE", "Polynomial", "call_numpy", "find_hint"]
