"""The settings of a decoder. `Method.settings` in `methods.py` says which of them a method reads."""

from typing import Annotated, Literal

from pydantic import AliasChoices, Field

from lare_rl.errors import CheckedModel, Count

__all__ = ["MULTI_AGENT_CREDIT", "RECENT_STEPS", "CreditSettings", "resolve_credit"]

RECENT_STEPS = 5000
"""Proxy rewards are compared with the true rewards over this number of newest steps of each agent."""

_Weight = Annotated[float, Field(ge=0)]


class CreditSettings(CheckedModel):
    """How the decoder is fitted."""

    hidden: tuple[Count, ...] = (256, 256)
    """Widths of the decoder's hidden layers."""
    learning_rate: Annotated[float, Field(gt=0)] = 3e-4
    """Adam's step size."""
    weight_decay: _Weight = 0.0
    """The weights times this are added to their gradient."""
    normalise: bool = True
    """Normalise features and returns by running statistics."""
    sum_form: bool = False
    """Fit an episode's return R (Eq. 6 of the paper), not R/T."""
    sampled_steps: Annotated[int, Field(ge=2, validation_alias=AliasChoices("sampled_steps", "drawn_steps"))] = 64
    """K: steps that RRD and its variants sample from an episode."""
    batch_steps: Annotated[int, Field(ge=2, validation_alias=AliasChoices("batch_steps", "steps"))] = 256
    """Steps in one update: K of each of batch_steps / K episodes, or whole episodes with about this many. On particle tasks (T = 25):
    batch_steps / T episodes, even if only K steps of each are sampled."""
    batch_episodes: Annotated[Count, Field(validation_alias=AliasChoices("batch_episodes", "episodes"))] = 8
    """diaster, rudder, grd and rbt: whole episodes in one update."""
    score: Literal["auto", "sum", "average", "binary"] = "auto"
    """The form of the score: `sum`, `average` or `binary`. `auto`: the task's `score` or, without one, a sum, unless an
    average has predicted returns clearly better."""
    start_value: bool = True
    """If lengths differ, a sum may have a part that does not grow with the number of steps, and that no step is paid for. Gradient
    decoders: not if `score` is `sum`."""
    exact: Literal["auto", "no", "last", "spread"] = "auto"
    """Make proxy rewards add up to the return: correct the `last` step, or `spread` the correction over all steps. `auto`:
    `last` for bayes-progress and lare-bayes-progress, else `no`."""
    encoder: tuple[Count, ...] = (256, 256)
    """Widths of the hidden layers of VIB's encoder."""
    bottleneck: Count = 8
    """Size of VIB's code."""
    divergence: _Weight = 5e-3
    """VIB: weight of the code's divergence against the squared error of the mean (with `sum_form`: T^2 times as much)."""
    sparsity: tuple[_Weight, _Weight, _Weight, _Weight, _Weight] = (1e-5, 1e-5, 1e-5, 1e-6, 1e-5)
    """grd: sparsity weights of five groups of causes. Of the reward: the state, the action. Of an entry of the next state: the other
    entries, the entry itself, the action."""


MULTI_AGENT_CREDIT = CreditSettings(
    hidden=(64, 64, 64, 64),
    learning_rate=5e-4,
    weight_decay=1e-5,
    sampled_steps=10,
    batch_steps=6400,
    encoder=(256,),
    bottleneck=4,
    divergence=1e-3,
)
"""The default settings of decoders for many agents. The numbers are those of LaRe's published code, except VIB's divergence."""


def resolve_credit(settings: CreditSettings | None, agents: int) -> CreditSettings:
    """Return the settings that were set, and the defaults of a decoder for one agent or many for all others."""
    defaults = CreditSettings() if agents == 1 else MULTI_AGENT_CREDIT
    changes = {} if settings is None else CreditSettings.model_validate(settings).model_dump(exclude_unset=True)
    return defaults.model_copy(update=changes)
