"""Benchmarks of the credit for turns: task families with exact values, baselines, learning curves, trust, cost."""
