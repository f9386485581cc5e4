"""What a method of credit is: inputs + fit + decoder, and what follows from them."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from lare_rl.credit.decoders import DECODERS, Decoder
from lare_rl.credit.input_names import InputNames
from lare_rl.errors import LareError, short_repr

__all__ = ["Fit", "Method", "Reward"]


class Fit(StrEnum):
    """How the decoder is fitted to returns (equations in `losses.py`)."""

    ALL_STEPS = "all steps"
    """RD: the proxy rewards of all T steps of an episode against its return."""
    SAMPLED_STEPS = "sampled steps"
    """RRD: K sampled steps of each episode."""
    SAMPLED_STEPS_UNBIASED = "sampled steps, unbiased"
    """RRD-unbiased: as RRD, minus the variance that the sampling adds."""
    LIKELIHOOD = "likelihood of sampled steps"
    """LRR: the likelihood of the return under rewards whose uncertainty the decoder learns (`lrr.py`)."""
    DECODER_LOSS = "the decoder's loss"
    """Diaster, RUDDER, GRD and RBT: the decoder's `loss` on whole episodes (in the files of these names)."""
    EVIDENCE = "evidence"
    """In closed form, on all episodes (`evidence.py`)."""
    PREFIX_EVIDENCE = "evidence of prefixes"
    """In closed form, on all prefixes: a step is paid the change of the expected return (`returns.py`)."""
    SIGNS = "best signs"
    """The best signs of a sum of the factors (`closed_form.py`)."""

    @property
    def closed_form(self) -> bool:
        """Whether the fit needs no gradient descent."""
        return self in (Fit.EVIDENCE, Fit.PREFIX_EVIDENCE, Fit.SIGNS)

    @property
    def samples_steps(self) -> bool:
        """Whether an update reads K steps of each episode, and not all of them."""
        return self in (Fit.SAMPLED_STEPS, Fit.SAMPLED_STEPS_UNBIASED, Fit.LIKELIHOOD)

    @property
    def separate(self) -> bool:
        """Whether the fit is too expensive for every update of the algorithm, and so runs between chunks of updates."""
        return self is Fit.DECODER_LOSS

    @property
    def settings(self) -> frozenset[str]:
        """The names of the `CreditSettings` that the fit reads."""
        match self:
            case Fit.DECODER_LOSS:
                names = {"episodes", "exact"}
            case Fit.EVIDENCE:
                names = {"score", "exact"}
            case Fit.PREFIX_EVIDENCE | Fit.SIGNS:
                names = {"exact"}
            case _:
                names = {"score", "sum_form", "steps", "exact"} | ({"sampled_steps"} if self.samples_steps else set())
        return frozenset(names if self.closed_form else names | {"learning_rate", "weight_decay", "normalise"})


class Reward(StrEnum):
    """What the algorithm is trained on."""

    TRUE = "true"
    EPISODIC = "episodic"
    PROXY = "proxy"
    """The output of the decoder."""
    UNIFORM = "uniform"
    """The mean reward of the episode, scaled to [0, 1] by the lowest and highest so far."""
    DESIGNED = "designed"
    """The output of a reward function that the language model wrote."""


@dataclass(frozen=True)
class Method:
    """A way to assign credit."""

    name: str
    summary: str
    source: str
    inputs: InputNames | None = None
    """What the decoder reads."""
    fit: Fit | None = None
    decoder: str = "step"
    """The name of a registered decoder."""
    reward: Reward = Reward.PROXY
    shared: bool = False
    """Whether all agents get the mean of their proxy rewards: credit over time, but not among agents."""

    def __post_init__(self) -> None:
        examples = {InputNames: 'InputNames(("observation", "action"))', Fit: "Fit.ALL_STEPS", Reward: "Reward.PROXY"}
        for value, (kind, example) in zip((self.inputs, self.fit, self.reward), examples.items(), strict=True):
            if not isinstance(value, kind | None):
                raise LareError(
                    f"method {self.name}: {short_repr(value)} is no {kind.__name__}: write {example}, for example"
                )

    @property
    def has_proxy_rewards(self) -> bool:
        """Whether it computes a proxy reward for each step."""
        return self.reward not in (Reward.TRUE, Reward.EPISODIC)

    @property
    def calibrated(self) -> bool:
        """Whether its rewards are in the unit of the true ones, because they are fitted to add up to returns."""
        return self.reward is Reward.PROXY

    @property
    def needs_phi(self) -> bool:
        """Whether it needs a function that a language model wrote."""
        return self.inputs is not None and self.inputs.has_factors

    @property
    def phi_kind(self) -> Literal["factors", "reward"]:
        """The kind of function that a language model is asked for, if the method needs one."""
        return "reward" if self.reward is Reward.DESIGNED else "factors"

    @property
    def uses_scored_observation(self) -> bool:
        """Whether it matters which observations the task's `scored_observation` names."""
        return self.needs_phi or (self.inputs is not None and self.inputs.depends_on_scored_observation)

    @property
    def uses_gradient(self) -> bool:
        """Whether its decoder is fitted by gradient descent."""
        return self.fit is not None and not self.fit.closed_form

    @property
    def decoder_kind(self) -> Decoder:
        """What is registered about its decoder."""
        return DECODERS[self.decoder]

    @property
    def settings(self) -> frozenset[str]:
        """The names of the `CreditSettings` that the method reads."""
        if self.fit is None:
            return frozenset()
        names = self.fit.settings | self.decoder_kind.settings
        return names - {"exact"} if self.decoder_kind.pays_shares else names  # shares always add up to the return

    def is_exact(self, exact: str) -> bool:
        """Return whether the setting `exact` corrects proxy rewards to add up to the return."""
        return exact in ("last", "spread") and "exact" in self.settings

    def choose_exact(self, exact: str) -> str:
        """Return how proxy rewards are made exact, by the setting `exact`."""
        if exact != "auto":
            return exact
        return "last" if self.fit is Fit.PREFIX_EVIDENCE else "no"

    @property
    def multi_agent_only(self) -> bool:
        """Whether it needs several agents."""
        return self.shared or self.decoder_kind.whole_episodes

    @property
    def single_agent_only(self) -> bool:
        """Whether it works for a single agent only: `Fit.DECODER_LOSS` has no axis of agents."""
        return self.fit is Fit.DECODER_LOSS or self.decoder_kind.single_agent_only
