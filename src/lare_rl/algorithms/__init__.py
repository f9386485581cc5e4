"""Reinforcement learning algorithms. They receive rewards, and do not know which method computed them.

Importing this package registers the built-in algorithms, without importing JAX.
"""

from importlib import import_module

for package in ("td3", "sac", "ppo", "qmix"):  # the order in lists and in `lare-rl train --help`
    import_module(f"lare_rl.algorithms.{package}")
