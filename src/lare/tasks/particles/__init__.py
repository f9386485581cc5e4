"""Multi-agent tasks in the plane, as pure functions that JAX compiles: `table.py` lists them."""
