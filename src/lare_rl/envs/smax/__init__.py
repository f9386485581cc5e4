"""Battles of two small armies in JAX, after SMAX. `scenarios.py` defines the armies, `battle.py` the rules."""
