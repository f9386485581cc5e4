"""`TurnCredit`: the credit of each turn of some rollouts, from their outcomes alone."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from lare_rl.errors import LareError, check_count, short_repr
from lare_rl.turns.features import COUNT, HAPPENED, LAST, Prefixes, TurnTable, build_prefixes, tabulate
from lare_rl.turns.regression import PrefixFit
from lare_rl.turns.rollouts import Phi, read_rollouts
from lare_rl.turns.trust import UNTRUSTED, Errors, Trust, choose_lambda, group_means, measure_errors, summarise
from lare_rl.turns.value import advantages, changes, fit_prefixes, held_out_values, posterior_stds, values
from lare_rl.turns.words import MESSAGES, count_decimals
from lare_rl.util.blas import one_blas_thread
from lare_rl.util.findings import Finding, render
from lare_rl.util.statistics import CLEAR_ERRORS

__all__ = ["EFFECT_KINDS", "CreditedTurns", "FeatureEffect", "TurnCredit"]

MAX_SENTENCES = 8
"""The largest number of features that are described in words."""
EFFECT_KINDS = {"first": (COUNT, HAPPENED, LAST), "lasting": (COUNT, HAPPENED), "further": (COUNT,)}
"""For each effect (see `FeatureEffect`): it is the sum of the weights of the prefix features of these kinds."""

TurnValues = list[Float[np.ndarray, " _"]]
"""One array for each rollout, with one number for each of its turns."""


class FeatureEffect(NamedTuple):
    """How a feature of a turn changes the value, in the unit of outcomes.

    Each effect is that of a feature of the size `feature_size`, and has its posterior standard deviation.
    """

    name: str
    feature_size: float
    """The mean size of the feature in the turns where it is not 0."""
    frequency: float
    """The share of the turns where it is not 0."""
    first: float
    """The change of value by the first turn with the feature."""
    first_std: float
    lasting: float
    """What remains of this change after further turns without the feature."""
    lasting_std: float
    further: float
    """What each further turn with the feature adds."""
    further_std: float

    @property
    def importance(self) -> float:
        """The mean of |`first`| over all turns, with 0 where the feature is 0."""
        return abs(self.first * self.frequency)


@dataclass(frozen=True)
class CreditedTurns:
    """The credit of the turns of some rollouts."""

    advantage: TurnValues
    """A_t, to train with: generalized advantages of the values."""
    progress: TurnValues
    """The change of value that a turn made, to read: the progress of a rollout adds up to its outcome minus its first value."""
    deviation: TurnValues
    """The posterior standard deviation of the progress. It is too small where features miss what matters."""
    value: TurnValues
    """V_t, the expected outcome before the turn."""
    lambda_: float
    """Lambda of the generalized advantages. If `is_grpo`, it is 1."""
    trust: Trust
    """The gain, its standard error, and the surprise at the end, over the latest calls."""
    effects: tuple[FeatureEffect, ...]
    """One for each feature of a turn."""
    reason: Finding
    """Why this lambda was used."""

    @property
    def is_grpo(self) -> bool:
        """Whether the values are not trusted, so that all turns of a rollout have the same advantage (`turns/trust.py`)."""
        return self.reason.code in UNTRUSTED

    @property
    def gain(self) -> float:
        """`Trust.gain`."""
        return self.trust.gain

    @property
    def surprise(self) -> float:
        """`Trust.surprise`."""
        return self.trust.surprise

    @property
    def words(self) -> list[str]:
        """Sentences: which lambda was used and why, and the effects of the features that matter most."""
        return [render(finding, MESSAGES) for finding in self.findings]

    @property
    def findings(self) -> list[Finding]:
        """What `words` says, as findings; `turns/words.py` has their sentences."""
        clear = [effect for effect in self.effects if abs(effect.first) > CLEAR_ERRORS * effect.first_std]
        clear.sort(key=lambda effect: -effect.importance)
        decimals = count_decimals(self.trust.outcome_std)
        return [
            Finding("grpo" if self.is_grpo else "lambda", {"lambda_": self.lambda_, "reason": self.reason}),
            *(Finding("effect", {**effect._asdict(), "decimals": decimals}) for effect in clear[:MAX_SENTENCES]),
        ]


class TurnCredit:
    """Gives credit to the turns of agents, from the outcomes of their rollouts.

    Each call fits the values of prefixes anew, to its own rollouts. Only the errors of the last `window` calls are remembered.
    """

    def __init__(self, lambda_: float | None = None, *, window: int = 20, phi: Phi | None = None):
        """Make an object that has seen no rollouts.

        Args:
            lambda_: of generalized advantages, 0 to 1. None: the trust in the values decides (`turns/trust.py`).
            window: the number of calls over which trust is measured.
            phi: a function from a turn to numbers with names, such as `load_turn_phi` reads. It needs rollouts with messages.

        Raises:
            LareError: a value is out of its range.
        """
        if lambda_ is not None and not (isinstance(lambda_, int | float | np.number) and 0 <= lambda_ <= 1):
            raise LareError(f"lambda_ must be None or a number from 0 to 1, and is {short_repr(lambda_)}")
        self.lambda_, self.window, self.phi = lambda_, check_count("window", window), phi
        self._errors: tuple[Errors, ...] = ()

    def __call__(self, rollouts: Iterable[Any]) -> CreditedTurns:
        """Return the credit of the turns of some rollouts (`turns/rollouts.py` has their form).

        Raises:
            LareError: there is no rollout, or a rollout is malformed.
        """
        checked = read_rollouts(rollouts, self.phi)
        if not checked:
            raise LareError("there are no rollouts: credit needs some, and several of each group")
        return self.assign(tabulate(checked))

    @one_blas_thread()
    def assign(self, table: TurnTable) -> CreditedTurns:
        """Return the credit of turns that are arrays already."""
        prefixes = build_prefixes(table)
        x = prefixes.features
        fit = fit_prefixes(table, x)
        value = values(table, x, fit)
        progress = changes(table, value)
        errors = measure_errors(table, held_out_values(table, x, fit))
        self._errors = (*self._errors, errors)[-self.window :]
        trust = summarise(self._errors)
        lambda_, reason = choose_lambda(trust)
        if self.lambda_ is not None:
            lambda_, reason = self.lambda_, Finding("chosen", {"measured": reason})
        if reason.code in UNTRUSTED:
            advantage = (table.outcome - group_means(table))[table.rollout_index]
        else:
            advantage = advantages(table, progress, lambda_)
        split = partial(np.split, indices_or_sections=table.first[1:])
        return CreditedTurns(
            advantage=split(advantage),
            progress=split(progress),
            deviation=split(posterior_stds(table, x, fit)),
            value=split(value),
            lambda_=float(lambda_),
            trust=trust,
            effects=_describe_effects(table, prefixes, fit),
            reason=reason,
        )


def _describe_effects(table: TurnTable, prefixes: Prefixes, fit: PrefixFit) -> tuple[FeatureEffect, ...]:
    """Return the effect of each feature of a turn."""
    effects = []
    for i, name in enumerate(table.names):
        column = table.features[:, i]
        is_nonzero = column != 0
        unit = float(np.abs(column[is_nonzero]).mean()) if is_nonzero.any() else 1.0
        size = np.where(prefixes.kind == HAPPENED, 1.0, unit) * (prefixes.feature_index == i)
        numbers = {}
        for effect, kinds in EFFECT_KINDS.items():
            row = size * np.isin(prefixes.kind, kinds)
            numbers[effect] = float(row @ fit.coefficients)
            numbers[f"{effect}_std"] = float(np.linalg.norm(fit.root[:, :-1] @ row))
        effects.append(FeatureEffect(name=name, feature_size=unit, frequency=float(is_nonzero.mean()), **numbers))
    return tuple(effects)
