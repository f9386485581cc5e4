"""The hyperparameters that all algorithms have which consume whole episodes."""

from lare_rl.algorithms.registry import AlgorithmSettings
from lare_rl.errors import Count

__all__ = ["SequenceSettings"]


class SequenceSettings(AlgorithmSettings):
    """How many episodes an update reads, and how often there is one."""

    batch_size: Count = 128
    """Episodes in one update."""
    update_every: Count = 8
    """New episodes for each update."""
    target_every: Count = 200
    """Episodes between two copies to the target networks, each after an update."""
