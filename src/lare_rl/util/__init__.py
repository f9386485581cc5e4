"""Helpers that know nothing of reinforcement learning: files, safe reading, float64, compilation."""
