"""Battles of two small armies in JAX, after SMAX. `scenarios.py` defines the armies, `battle.py` the rules.

This module contains only names, so that listing tasks and verifying functions do not import JAX.
"""

SCENARIO_NAMES = ("2s3z", "3s_vs_5z", "1c3s5z")
