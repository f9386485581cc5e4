"""Multi-agent particle tasks in JAX. `catalogue.py` lists them, `world.py` has their physics."""
