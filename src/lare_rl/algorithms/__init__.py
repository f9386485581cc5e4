"""Reinforcement learning algorithms. They receive rewards, and do not know which method computed them."""
