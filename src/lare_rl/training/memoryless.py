"""Functions shared by the algorithms without memory, which consume transitions or rollouts."""

from typing import Any

from jaxtyping import Array, Int

from lare_rl.training.learner import Learner
from lare_rl.training.static_config import TrainConfig

__all__ = ["get_actor", "init_memory"]


def get_actor(learner: Learner, env_steps: int | Int[Array, ""], config: TrainConfig) -> Any:
    """Return the parts of the learner that are needed to act, for all seeds."""
    return config.algorithm.load().get_actor(learner.algorithm)


def init_memory(config: TrainConfig) -> tuple[()]:
    """Return the memory of an actor: none."""
    return ()
