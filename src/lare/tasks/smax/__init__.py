"""Battles of two small armies in JAX, after SMAX: see `scenarios.py` for who fights, `battle.py` for how.

Only names stand here: who lists tasks, or verifies a function, need not wait for JAX.
"""

NAMESPACE = "smax/"
"""What the environment of such a task's spec begins with; the rest is its name in `scenarios.py`."""

NAMES = ("2s3z", "3s_vs_5z", "1c3s5z")
