"""Shows the steps of another library's environments to a `CreditAssigner`."""

from collections.abc import Hashable, Mapping, Sequence
from typing import Any, Literal, get_args

import gymnasium
import numpy as np
from jaxtyping import Bool, Float, Int

from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.assigner.space_layout import make_layout
from lare_rl.errors import LareError, short_repr

__all__ = ["CREDIT_STEP", "Pay", "StepRecorder", "check_assigner", "check_capacity", "check_pay"]

CREDIT_STEP = "credit_step"
"""The key under which the number of a step is stored, for `CreditAssigner.rewards_at`."""

Pay = Literal["proxy", "environment"]
"""The reward that `step` of a wrapper returns: r_hat, or the environment's."""


class StepRecorder:
    """Shows steps to an assigner. If it knows only sizes, from a task file, steps first become rows of numbers, by these spaces."""

    def __init__(
        self,
        credit: CreditAssigner,
        observation_space: gymnasium.Space,
        action_space: gymnasium.Space,
        env_ids: Sequence[Hashable],
        agents: int = 1,
    ):
        """Create a recorder for environments with these spaces, which are those of one environment and one agent.

        `env_ids` holds a key for each environment, which no other environment of the assigner has. Raises `LareError` if the
        assigner was made for other spaces or sizes, or another number of agents.
        """
        check_assigner(credit, agents)
        self.credit, self.env_ids = credit, env_ids
        self.layouts = {
            "observation": make_layout(observation_space, "observation_space"),
            "action": make_layout(action_space, "action_space"),
        }
        expected = {"observation": credit.config.observation, "action": credit.config.action}
        for kind, layout in self.layouts.items():
            if layout.size != expected[kind].size:
                raise LareError(
                    f"{kind}s of the environment are rows of {layout.size} numbers, and the assigner was made for {expected[kind].size}"
                )
            if layout != expected[kind] and expected[kind].kind != "numbers":
                raise LareError(f"the assigner was made for another {kind}_space than that of the environment")
        self._has_same_layout = {kind: layout == expected[kind] for kind, layout in self.layouts.items()}

    def add(
        self,
        observation: Any,
        action: Any,
        next_observation: Any,
        reward: Any,
        terminated: Any,
        truncated: Any,
        *,
        infos: Sequence[Mapping[str, Any]],
        valid: Bool[np.ndarray, " environments"] | None = None,
    ) -> Int[np.ndarray, " environments"]:
        """Show one step of each environment, and return their numbers: see `CreditAssigner.add`.

        `infos` holds one mapping for each environment. Only groups are read from them, so without groups it may be empty.
        """
        steps = {"observation": observation, "action": action, "next_observation": next_observation}
        for name, value in steps.items():
            kind = name.removeprefix("next_")
            if not self._has_same_layout[kind]:
                steps[name] = self.layouts[kind].rows(value, name)
        return self.credit.add(
            **steps,
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            env_ids=self.env_ids,
            valid=valid,
            group=self.read_groups(infos),
        )

    def proxy_rewards(self, steps: Int[np.ndarray, " environments"]) -> Float[np.ndarray, "environments *agents"]:
        """Return r_hat of these steps, after pending updates of the decoder."""
        self.credit.fit_pending()
        return self.credit.rewards_at(steps)

    def read_groups(self, infos: Sequence[Mapping[str, Any]]) -> list[Any] | None:
        """Return the groups of episodes from the infos of their steps, None where a step has none. None without groups."""
        config = self.credit.config
        return [info.get(config.group_key) for info in infos] if config.groups else None

    def skip_unseen(self, env_index: int, observation: Any) -> None:
        """See `CreditAssigner.skip_unseen`. `observation` is a batch, with a row for each environment."""
        rows = self.layouts["observation"].rows(observation, "observation")
        self.credit.skip_unseen(self.env_ids[env_index], rows[env_index])

    def drop(self, env_index: int) -> None:
        """Give up the running episode of an environment, which was reset."""
        self.credit.drop(self.env_ids[env_index])


def check_assigner(credit: object, agents: int = 1) -> None:
    """Raise `LareError` if `credit` is not an assigner for this number of agents."""
    if not isinstance(credit, CreditAssigner):
        raise LareError(f"credit must be a CreditAssigner, and is {short_repr(credit)}")
    if credit.config.agents != agents:
        raise LareError(
            f"the assigner was made for agents={credit.config.agents}, and the environment has {agents}: create it with agents={agents}"
        )


def check_capacity(credit: CreditAssigner, n_steps: int) -> None:
    """Raise `LareError` if an assigner keeps fewer steps than a buffer."""
    capacity = credit.store.capacity
    if capacity < n_steps:
        raise LareError(f"the assigner keeps {capacity} steps, the buffer {n_steps}: create it with capacity={n_steps}")


def check_pay(pay: str) -> None:
    """Raise `LareError` if `pay` is unknown."""
    if pay not in get_args(Pay):
        raise LareError(f"pay = {pay!r} must be 'proxy' or 'environment'")
