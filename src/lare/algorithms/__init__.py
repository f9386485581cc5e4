"""Reinforcement learning: knows rewards, never where they come from."""
