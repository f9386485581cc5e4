"""When an environment pays, and for which steps."""

from dataclasses import dataclass
from typing import Any

from lare_rl.errors import check_count

__all__ = ["PAID_AT_END", "PaymentRule", "is_paid"]


@dataclass(frozen=True)
class PaymentRule:
    """When an environment pays. At the end of an episode it always pays."""

    period: int | None = None
    """It pays every `period` steps."""
    nonzero: bool = False
    """Every reward that is not 0 is a payment."""
    window: int | None = None
    """A payment is for this number of last steps of its episode, the one that is paid included. None means all steps since the last
    payment."""

    def __post_init__(self) -> None:
        for name in ("period", "window"):
            if getattr(self, name) is not None:
                check_count(name, getattr(self, name))

    @property
    def only_at_end(self) -> bool:
        """Whether an episode is paid once, for all of its steps."""
        return self == PAID_AT_END

    @property
    def pays_early(self) -> bool:
        """Whether it may pay before the end of an episode."""
        return self.nonzero or self.period is not None

    @property
    def for_scores(self) -> "PaymentRule":
        """The rule for an episode of which only the score is known: it is paid once, at its end.

        `window` is kept only if the environment pays once, too. Otherwise it is that of earlier payments.
        """
        return PAID_AT_END if self.pays_early else self

    def longest_segment(self, max_steps: int) -> int:
        """Return the largest number of steps that a payment is for, in episodes of at most `max_steps` steps."""
        return min(max_steps, self.window or self.period or max_steps)

    def is_regular(self, max_steps: int) -> bool:
        """Whether all payments of an episode of `max_steps` steps are for the same number of steps."""
        return not self.nonzero and self.window is None and max_steps % (self.period or max_steps) == 0


PAID_AT_END = PaymentRule()


def is_paid(rule: PaymentRule, step: Any, team_reward: Any, ended: Any) -> Any:
    """Return at which steps an environment pays. The arrays are of NumPy or of JAX.

    `step` [*batch] is the index of the step in its episode, from 0; `team_reward` [*batch teams] are the rewards; `ended` [*batch]
    says whether the episode ended with this step.
    """
    pays = ended
    if rule.period is not None:
        pays = pays | ((step + 1) % rule.period == 0)
    if rule.nonzero:
        pays = pays | (team_reward != 0).any(axis=-1)
    return pays
