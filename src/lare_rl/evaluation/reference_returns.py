"""Returns of random actions and of a trained policy on some tasks."""

from typing import NamedTuple

__all__ = ["REFERENCE_RETURNS", "ReferenceReturns"]


class ReferenceReturns(NamedTuple):
    """The returns that count as the scores 0 and 1 of a task."""

    random: float
    """The mean over 20 episodes of uniformly random actions."""
    trained: float
    """About the highest published return of TD3 on true rewards within a million steps, from Tianshou's benchmark or, for Walker2d,
    from the paper of TD3."""


REFERENCE_RETURNS = {
    "Reacher-v4": ReferenceReturns(-44.0, -2.7),
    "Walker2d-v4": ReferenceReturns(3.4, 4600.0),
    "HalfCheetah-v4": ReferenceReturns(-271.0, 10_200.0),
}
