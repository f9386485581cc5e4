"""Multi-agent particle tasks in JAX: see `table.py` for all of them, `world.py` for their physics, `env.py` for training."""
