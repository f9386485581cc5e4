"""The settings of a decoder. `Method.settings` in `methods.py` says which of them a method reads."""

from typing import Annotated, Literal

from pydantic import AliasChoices, Field

from lare_rl.errors import CheckedModel

RECENT_STEPS = 5000
"""Proxy rewards are compared with the true rewards over this number of newest steps of each agent."""

_Weight = Annotated[float, Field(ge=0)]


class CreditSettings(CheckedModel):
    """How the decoder is fitted."""

    hidden: tuple[Annotated[int, Field(ge=1)], ...] = (256, 256)
    """Widths of the decoder's hidden layers."""
    learning_rate: Annotated[float, Field(gt=0)] = 3e-4
    """Adam's step size."""
    weight_decay: Annotated[float, Field(ge=0)] = 0.0
    """The factor by which the weights are added to their gradient."""
    normalise: bool = True
    """Normalise features and returns by running statistics. The published form does not."""
    sum_form: bool = False
    """Fit the return R of an episode (Eq. 6 of the paper), not its mean R/T (the published code for one agent)."""
    sampled_steps: Annotated[int, Field(ge=2, validation_alias=AliasChoices("sampled_steps", "drawn_steps"))] = 64
    """K: the number of steps that RRD and its variants sample from an episode."""
    steps: Annotated[int, Field(ge=2)] = 256
    """Steps in one update of the decoder: K steps from each of steps / K episodes, or whole episodes with about this many steps in
    total. On particle tasks, whose episodes all have T = 25 steps: steps / T episodes, even if only K steps of each are sampled."""
    episodes: Annotated[int, Field(ge=1)] = 8
    """diaster, rudder, grd and rbt (single agents): whole episodes in one update of the decoder."""
    score: Literal["auto", "sum", "average", "binary"] = "auto"
    """Whether the score of an episode is a sum over its steps; an average or a grade, which does not grow with the number of steps;
    or binary: won or lost. `auto`: the task's `score` or, without one, a sum or an average, whichever has predicted returns better
    so far."""
    exact: Literal["auto", "no", "last", "spread"] = "auto"
    """Whether the proxy rewards of an episode are corrected, so that they add up to its return: by adding the difference to the
    reward of its last step, or by spreading it over its steps. `auto`: `last` for bayes-progress and lare-bayes-progress, else
    `no`."""
    encoder: tuple[Annotated[int, Field(ge=1)], ...] = (256, 256)
    """Widths of the hidden layers of VIB's encoder."""
    bottleneck: Annotated[int, Field(ge=1)] = 8
    """Size of the code in the middle of VIB."""
    divergence: Annotated[float, Field(ge=0)] = 5e-3
    """Weight of the code's divergence relative to the squared error of the mean (with `sum_form`: T^2 times as much)."""
    sparsity: tuple[_Weight, _Weight, _Weight, _Weight, _Weight] = (1e-5, 1e-5, 1e-5, 1e-6, 1e-5)
    """grd: weights of the sparsity of five groups of causes: those in the state and in the action for the reward; those in the
    state for its other entries, for the entry itself, and in the action for the next state."""


MULTI_AGENT_CREDIT = CreditSettings(
    hidden=(64, 64, 64, 64),
    learning_rate=5e-4,
    weight_decay=1e-5,
    sampled_steps=10,
    steps=6400,
    encoder=(256,),
    bottleneck=4,
    divergence=1e-3,
)
"""The default settings of decoders for many agents. The numbers are those of LaRe's published code, except VIB's divergence."""


def default_credit(agents: int) -> CreditSettings:
    """Return the default settings of a decoder for one agent or many."""
    return CreditSettings() if agents == 1 else MULTI_AGENT_CREDIT
