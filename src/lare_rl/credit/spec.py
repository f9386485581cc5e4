"""What is fitted to what, for one team: a method, its settings, and the sizes of a task. All that follows from them is computed here."""

import math
from dataclasses import dataclass
from functools import cached_property

from lare_rl.credit.basis import Basis
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.input_names import N_EXTREMES, NOT_RAW, input_sizes, raw_feature_names
from lare_rl.credit.methods import Fit, Method
from lare_rl.credit.prequential import SEGMENT_WINDOW, WINDOW
from lare_rl.credit.score_type import ScoreType
from lare_rl.errors import LareError
from lare_rl.tasks.payments import PAID_AT_END, PaymentRule
from lare_rl.tasks.spec import MAX_LEVELS, ScoredObservation

__all__ = ["CreditSpec"]


@dataclass(frozen=True, kw_only=True)
class CreditSpec:
    """What is fitted to what: the static part of credit assignment for one team."""

    method: Method
    settings: CreditSettings
    n_factors: int = 0
    observation_size: int
    """The size of an observation or, for credit to whole teams, of the global state."""
    action_size: int
    scored_observation: ScoredObservation = "after"
    single_agent: bool
    """Whether the environment has a single agent, and credit is not to the global state. If false, `agents` may still be 1."""
    agents: int
    """The number of proxy rewards of a step."""
    max_steps: int
    """The number of steps of the longest episode; in training, of the longest segment."""
    fixed_length: bool = False
    """Whether all episodes have the same length. A sum and an average are then the same."""
    payments: PaymentRule = PAID_AT_END
    has_groups: bool = False
    """Whether episodes may belong to levels (for users: groups), each with its own intercept."""
    scale_rewards: bool = False
    """Whether training rewards are divided by the running root mean square of R/T."""

    @property
    def is_exact(self) -> bool:
        """Whether the proxy rewards of an episode are corrected to add up to its return."""
        return self.settings.exact in ("last", "spread") and "exact" in self.method.settings

    @property
    def prediction_window(self) -> int:
        """The number of last returns (or payments) over which R^2 and gain are computed (`prequential.py`)."""
        return WINDOW if self.payments.only_at_end and self.settings.score != "binary" else SEGMENT_WINDOW

    @property
    def n_levels(self) -> int:
        """The number of levels that episodes may belong to."""
        return MAX_LEVELS if self.has_groups else 0

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        """The names of the decoder's inputs (`input_names.py`)."""
        names = self.method.inputs
        return () if names is None else names.resolve(self.scored_observation, single_agent=self.single_agent)

    @cached_property
    def input_sizes(self) -> tuple[tuple[str, int], ...]:
        """The name and the size of each input."""
        sizes = {"factors": self.n_factors, "observation": self.observation_size, "action": self.action_size}
        return input_sizes(self.inputs, sizes)

    @property
    def _raw_sizes(self) -> dict[str, int]:
        return {name: size for name, size in self.input_sizes if name not in NOT_RAW}

    @cached_property
    def basis(self) -> Basis:
        """The features that a closed-form decoder computes from a row of inputs."""
        sizes = dict(self.input_sizes)
        return Basis(
            n_factors=sizes.get("factors", 0),
            n_raw=sum(self._raw_sizes.values()),
            extended=self.method.decoder_kind.extended_basis,
            n_tracked=sizes.get("history", 0) // N_EXTREMES,
            n_levels=0 if self.method.fit is Fit.SIGNS else self.n_levels,
            prefixes=self.method.fit is Fit.PREFIX_EVIDENCE,
            start_value=self.method.has_start_value(self.settings, fixed_length=self.fixed_length),
        )

    @cached_property
    def score_types(self) -> tuple[ScoreType, ...]:
        """The score types that are fitted, in the order of `ScoreType`. Without features, no fit in closed form can compare them."""
        score = self.settings.score
        if "score" not in self.method.settings or not self.basis.n_features:
            return (ScoreType.SUM,)
        if score in ("sum", "average"):
            return (ScoreType[score.upper()],)
        linear = (ScoreType.SUM,) if self.fixed_length else (ScoreType.SUM, ScoreType.AVERAGE)
        return (*linear, ScoreType.LOG_ODDS) if score == "binary" and not self.method.uses_gradient else linear

    @property
    def has_closed_form(self) -> bool:
        """Whether there is a fit in closed form.

        It is the decoder, or it helps a gradient decoder: it compares score types, or gives the mean return of an average, which no step is
        paid for.
        """
        return self.method.fit is not None and (self.method.fit.closed_form or self.score_types != (ScoreType.SUM,))

    @property
    def normalises(self) -> bool:
        """Whether the decoder's inputs and outputs are normalised. A decoder in closed form does not need this."""
        return self.settings.normalise and self.method.uses_gradient

    def sizes(self, *names: str) -> list[int]:
        """Return the sizes of the inputs. Raises `LareError` if their names, in order, are not `names`."""
        if self.inputs != names:
            raise LareError(
                f"this decoder reads the inputs {', '.join(names)}, and its method has {dict(self.input_sizes)}: register the method "
                f"with inputs=InputNames({names!r})"
            )
        return [size for _, size in self.input_sizes]

    @property
    def n_inputs(self) -> int:
        return self.basis.n_inputs

    @property
    def output_scale(self) -> float:
        """The factor sqrt(nT) of a decoder's output for n agents, or 1 for a single agent. T is `max_steps`.

        R/T is the mean of nT rewards. A reward that is paid sqrt(nT) times among them is larger than this mean by that factor. An update of
        Adam changes the output by about the same amount, whatever the unit of the targets is. The decoder of many agents has few updates.
        Without this factor, its output would reach the size of a rare reward only after dozens of updates of the policy.
        """
        return 1.0 if self.agents == 1 else math.sqrt(self.max_steps * self.agents)

    def raw_feature_names(self, observation: str, action: str) -> list[str]:
        """Return names of the raw features, from a task's texts; none if they are not entries of observations and actions."""
        if not self.basis.n_raw_used or "observation_change" in self.inputs:
            return []
        return raw_feature_names(observation, action, self._raw_sizes)
