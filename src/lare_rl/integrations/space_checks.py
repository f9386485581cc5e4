"""Checks that an environment and an assigner have the same observations and actions, and converts between their forms."""

from typing import Any

import gymnasium

from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.assigner.layout import layout_of
from lare_rl.errors import LareError, shortened


def check_assigner(credit: object) -> None:
    """Raise `LareError` if `credit` is not an assigner."""
    if not isinstance(credit, CreditAssigner):
        raise LareError(f"credit must be a CreditAssigner, and is {shortened(credit)}")


class Rows:
    """Observations and actions of an environment, in the form that its assigner takes.

    If both have the same spaces, values are passed on unchanged. If the assigner knows only how many numbers there are, for
    instance from a task file, values become rows of numbers.

    Raises:
        LareError: the assigner was made for other sizes.
    """

    def __init__(self, credit: CreditAssigner, observations: gymnasium.Space, actions: gymnasium.Space):
        check_assigner(credit)
        self.observation, self.action = layout_of(observations, "observation_space"), layout_of(actions, "action_space")
        known = credit.config
        for name, own, other in (
            ("observation", self.observation, known.observation),
            ("action", self.action, known.action),
        ):
            if own.size != other.size:
                raise LareError(
                    f"{name}s of the environment are rows of {own.size} numbers, and the assigner was made for {other.size}"
                )
        self.same = self.observation == known.observation, self.action == known.action

    def observations(self, batch: Any, name: str) -> Any:
        """A batch of observations."""
        return batch if self.same[0] else self.observation.rows(batch, name)

    def actions(self, batch: Any) -> Any:
        """A batch of actions."""
        return batch if self.same[1] else self.action.rows(batch, "action")
