"""Battles of two small armies in JAX, after SMAX. `scenarios.py` defines the armies, `battle.py` the rules.

This module contains only names, so that listing tasks and verifying functions do not import JAX.
"""

NAMESPACE = "smax/"
"""The prefix of such environments in a spec. The rest is a name in `scenarios.py`."""

NAMES = ("2s3z", "3s_vs_5z", "1c3s5z")
