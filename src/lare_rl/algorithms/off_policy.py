"""The hyperparameters and default run settings that TD3, DDPG and SAC share."""

from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from lare_rl.algorithms.registry import AlgorithmSettings
from lare_rl.errors import Count

if TYPE_CHECKING:
    from lare_rl.envs.interface import EnvSpec

__all__ = ["OffPolicySettings", "run_defaults"]


class OffPolicySettings(AlgorithmSettings):
    """The hyperparameters that these algorithms share. None depends on the task."""

    hidden: tuple[Count, ...] = (256, 256)
    """Widths of the hidden layers of actor and critics."""
    critics: Count = 2
    """Number of critics. The target uses their smallest value."""
    learning_rate: Annotated[float, Field(gt=0)] = 3e-4
    """Learning rate of Adam."""
    batch_size: Count = 256
    """Transitions in one update."""
    gamma: Annotated[float, Field(ge=0, le=1)] = 0.99
    """Discount factor."""
    tau: Annotated[float, Field(gt=0, le=1)] = 0.005
    """Fraction of the online networks in each Polyak update of the target networks."""
    warmup: Annotated[int, Field(ge=0)] = 10_000
    """Environment steps with uniformly random actions before the first update."""


def run_defaults(env: "EnvSpec", environments: int | None) -> dict[str, Any]:
    """Return the default run settings."""
    return {"environments": environments or 1}
