"""TD3 and DDPG: hyperparameters and registration. The update is in `td3.py`."""

from dataclasses import replace
from typing import Annotated

from pydantic import Field

from lare_rl.algorithms.off_policy import OffPolicySettings, run_defaults
from lare_rl.algorithms.registry import Algorithm, Consumes, register_algorithm
from lare_rl.errors import Count

__all__ = ["TD3Settings"]


class TD3Settings(OffPolicySettings):
    """Hyperparameters, as the LaRe paper sets them. The targets move at each policy update."""

    policy_noise: Annotated[float, Field(ge=0)] = 0.2
    """Standard deviation of the noise on the target action, in action bounds."""
    noise_clip: Annotated[float, Field(ge=0)] = 0.5
    """Bound of the noise on the target action."""
    policy_delay: Count = 2
    """Critic updates for each update of actor and targets."""
    exploration_noise: Annotated[float, Field(ge=0)] = 0.1
    """Standard deviation of the noise on actions, in action bounds."""

    @property
    def unused_names(self) -> tuple[str, ...]:
        return () if self.policy_noise else ("noise_clip",)


_TD3 = Algorithm(
    name="td3",
    consumes=Consumes.TRANSITIONS,
    settings=TD3Settings(),
    module="lare_rl.algorithms.td3.td3",
    run_defaults=run_defaults,
    summary="two critics against overestimation, a delayed deterministic policy",
    source="Fujimoto et al., ICML 2018",
    discrete=False,
)
register_algorithm(_TD3)
register_algorithm(
    replace(
        _TD3,
        name="ddpg",
        settings=TD3Settings(critics=1, policy_noise=0.0, policy_delay=1),
        summary="one critic and a deterministic policy",
        source="Lillicrap et al., ICLR 2016",
    )
)
