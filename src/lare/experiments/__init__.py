"""Experiments: reports and comparisons of runs, evaluations of their policies, and sweeps of many runs."""
