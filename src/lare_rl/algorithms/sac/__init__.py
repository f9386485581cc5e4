"""SAC: hyperparameters and registration. The update is in `sac.py`."""

from typing import Annotated

from pydantic import Field

from lare_rl.algorithms.off_policy import OffPolicySettings, run_defaults
from lare_rl.algorithms.registry import Algorithm, Consumes, register_algorithm
from lare_rl.errors import Count

__all__ = ["SACSettings"]


class SACSettings(OffPolicySettings):
    """Hyperparameters, as the LaRe paper sets them. Its code has `target_every` = 2."""

    target_every: Count = 1
    """Updates between two moves of the target critics."""
    temperature: Annotated[float, Field(gt=0)] = 1.0
    """Temperature alpha at the start."""


register_algorithm(
    Algorithm(
        name="sac",
        consumes=Consumes.TRANSITIONS,
        settings=SACSettings(),
        module="lare_rl.algorithms.sac.sac",
        run_defaults=run_defaults,
        summary="maximum entropy, with a learned temperature",
        source="Haarnoja et al., 2018 (arXiv 1812.05905)",
        discrete=False,
    )
)
