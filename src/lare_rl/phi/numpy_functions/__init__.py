"""NumPy's functions, made of the operations of the graph."""

from lare_rl.phi.numpy_functions import creation, elementwise, products, reductions, shapes, tables
from lare_rl.phi.numpy_functions.registry import FUNCTIONS, call_numpy

__all__ = ["FUNCTIONS", "call_numpy", "creation", "elementwise", "products", "reductions", "shapes", "tables"]
