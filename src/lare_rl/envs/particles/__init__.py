"""Multi-agent particle tasks in JAX. `table.py` lists them, `world.py` has their physics, `env.py` the training environment."""
