"""What a method of credit is, and the table of methods: all published ways to assign credit, as inputs + fit + decoder.

A *method* determines the rewards that the algorithm is trained on. `inputs` names what the decoder reads, `fit` the way it is fitted
to returns, and `decoder` its kind. `dense`, `episodic`, `ircr` and `llm-reward` fit nothing. A method works for a single agent and for
several, unless its row says otherwise.

`register_method` adds a method, for this package and for plugins alike.
"""

from dataclasses import dataclass, replace
from enum import StrEnum
from types import NoneType
from typing import Literal

from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decoders import DECODERS, Decoder
from lare_rl.credit.input_names import InputNames
from lare_rl.errors import LareError, short_repr
from lare_rl.util.plugins import Registry

__all__ = ["FACTORS_ALONE", "METHODS", "Fit", "Method", "Reward", "register_method"]


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
    """In closed form, on all prefixes: a step is paid the change of the expected return (`learning.py`)."""
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
    def settings(self) -> frozenset[str]:
        """The names of the `CreditSettings` that the fit reads."""
        match self:
            case Fit.DECODER_LOSS:
                names = {"batch_episodes", "exact"}
            case Fit.EVIDENCE:
                names = {"score", "start_value", "exact"}
            case Fit.PREFIX_EVIDENCE | Fit.SIGNS:
                names = {"exact"}
            case _:
                names = {"score", "start_value", "sum_form", "batch_steps", "exact"} | (
                    {"sampled_steps"} if self.samples_steps else set()
                )
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
    fit: Fit | None = None
    decoder: str = "step"
    """The name of a registered decoder."""
    reward: Reward = Reward.PROXY
    shared: bool = False
    """Whether all agents get the mean of their proxy rewards: credit over time, but not among agents."""

    def __post_init__(self) -> None:
        for value, kinds, example in (
            (self.inputs, (InputNames, NoneType), 'InputNames(("observation", "action"))'),
            (self.fit, (Fit, NoneType), "Fit.ALL_STEPS"),
            (self.reward, (Reward,), "Reward.PROXY"),
            (self.decoder, (str,), '"step", a registered decoder'),
        ):
            if not isinstance(value, kinds):
                raise LareError(
                    f"method {self.name}: {short_repr(value)} is no {kinds[0].__name__}: write {example}, for example"
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
        return self.needs_phi or (self.inputs is not None and "scored_observation" in self.inputs.names)

    @property
    def uses_gradient(self) -> bool:
        """Whether its decoder is fitted by gradient descent."""
        return self.fit is not None and not self.fit.closed_form

    @property
    def samples_steps(self) -> bool:
        """Whether an update of its decoder reads K steps of each episode."""
        return self.fit is not None and self.fit.samples_steps

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

    def choose_exact(self, exact: str) -> str:
        """Return how proxy rewards are made exact, by the setting `exact`."""
        if exact != "auto":
            return exact
        return "last" if self.fit is Fit.PREFIX_EVIDENCE else "no"

    def has_start_value(self, settings: CreditSettings, *, fixed_length: bool) -> bool:
        """Return whether a sum may have a start value. `fixed_length` is whether all episodes have the same length."""
        is_read = "start_value" in self.settings and settings.score != "average" and not fixed_length
        return is_read and settings.start_value

    @property
    def multi_agent_only(self) -> bool:
        return self.shared or self.decoder_kind.whole_episodes

    @property
    def single_agent_only(self) -> bool:
        """Whether it works for a single agent only: `Fit.DECODER_LOSS` has no axis of agents."""
        return self.fit is Fit.DECODER_LOSS or self.decoder_kind.single_agent_only


METHODS = Registry[Method]("method")


def register_method(method: Method) -> None:
    """Add a method, by whose name `lare-rl train --method` and `CreditAssigner` then find it.

    Raises:
        LareError: another method has this name, its decoder is not registered, or its inputs, fit and decoder do not go together.
    """
    DECODERS.find(method.decoder)
    if problem := _find_conflict(method):
        raise LareError(f"method {method.name}: {problem}")
    METHODS.register(method.name, method)


def _find_conflict(method: Method) -> str | None:
    """Return why a method's inputs, fit and decoder do not go together, or None."""
    fit, decoder, kind = method.fit, method.decoder, method.decoder_kind
    if method.reward is not Reward.PROXY:
        return None
    if method.inputs is None or fit is None:
        return "proxy rewards need inputs and a fit"
    if fit is Fit.SIGNS and (kind.extended_basis or not kind.closed_form or not method.needs_phi):
        return "Fit.SIGNS needs factors and the decoder 'linear'"
    if fit.closed_form != kind.closed_form:
        needed = "decoder 'linear' or 'additive'" if fit.closed_form else "decoder with gradients"
        return f"Fit.{fit.name} needs a {needed}, not {decoder!r}"
    if fit.samples_steps and kind.whole_episodes:
        return f"Fit.{fit.name} reads some steps of an episode, and the decoder {decoder!r} all of them"
    if not fit.closed_form and "history" in (*method.inputs.names, *(method.inputs.names_of_many_agents or ())):
        return "the input history needs a fit in closed form"  # it is NaN before the first step
    if fit in (Fit.LIKELIHOOD, Fit.DECODER_LOSS) and decoder in ("step", "bottleneck"):
        needed = "a standard deviation" if fit is Fit.LIKELIHOOD else "a loss of its own"
        return f"Fit.{fit.name} needs a decoder with {needed}, not {decoder!r}"
    return None


RAW = InputNames(("observation", "action", "observation_change"), ("next_observation",))
"""As published for RD and RRD."""
OBSERVATION_ACTION = InputNames(("observation", "action"))
TRANSITION = InputNames(("observation", "action", "next_observation"))
NEXT_OBSERVATION_ACTION = InputNames(("next_observation", "action"))
SCORED = InputNames(("scored_observation", "action"))
FACTORS = InputNames(("factors",))
FACTORS_AND_SCORED = InputNames(("factors", "scored_observation", "action"))
SCORED_AND_HISTORY = InputNames(("scored_observation", "action", "history"))
FACTORS_SCORED_AND_HISTORY = InputNames(("factors", "scored_observation", "action", "history"))

_LARE = "Qu et al., LaRe, AAAI 2025"
_RD = "Efroni et al., AAAI 2021; Arjona-Medina et al., RUDDER, 2019"
_RRD = "Ren et al., RRD, ICLR 2022"
_BAYES = "this package, docs/explanation/closed-form.md; Efroni et al., AAAI 2021; MacKay, 1992"
_PROGRESS = "this package, docs/explanation/closed-form.md; Ng et al., ICML 1999"
_VIB = "Alemi et al., ICLR 2017; LaRe, appendix F.2"

# fmt: off
for _method in (
    Method("dense", "the true reward of every step: the upper reference", "-", reward=Reward.TRUE),
    Method("episodic", "the return, paid at the last step: the lower reference", "-", reward=Reward.EPISODIC),
    Method("ircr", "the same reward for all steps of an episode, from 0 (the worst episode) to 1 (the best)",
           "Gangwani et al., IRCR, NeurIPS 2020", reward=Reward.UNIFORM),
    Method("rd", "return decomposition on raw features", _RD, RAW, Fit.ALL_STEPS),
    Method("rrd", "randomized return decomposition", _RRD, RAW, Fit.SAMPLED_STEPS),
    Method("rrdu", "RRD without the bias of drawing steps", _RRD, RAW, Fit.SAMPLED_STEPS_UNBIASED),
    Method("rrdu-next", "rrdu on the next state and the action", f"{_RRD}; inputs: this package",
           NEXT_OBSERVATION_ACTION, Fit.SAMPLED_STEPS_UNBIASED),
    Method("lrr", "likelihood of the return under Gaussian rewards, leaving out each step in turn",
           "Xiao and Jiao, LRR, 2025 (after the abstract; no code found)", RAW, Fit.LIKELIHOOD, "lrr"),
    Method("rd-linear", "linear regression on the state and the action", _BAYES, SCORED, Fit.EVIDENCE, "linear"),
    Method("bayes", "regression on functions of the entries of the state and the action", _BAYES,
           SCORED, Fit.EVIDENCE, "additive"),
    Method("vib-rd", "RD after a learned information bottleneck", _VIB, RAW, Fit.ALL_STEPS, "bottleneck"),
    Method("vib-rrdu", "RRD-unbiased after a learned information bottleneck", _VIB,
           RAW, Fit.SAMPLED_STEPS_UNBIASED, "bottleneck"),
    Method("rudder", "differences between an LSTM's predictions of the return, distilled into a model of single steps",
           "Arjona-Medina et al., RUDDER, NeurIPS 2019", RAW, Fit.DECODER_LOSS, "rudder"),
    Method("diaster", "differences between predicted rewards of pieces of an episode", "Lin et al., Diaster, AAAI 2024",
           OBSERVATION_ACTION, Fit.DECODER_LOSS, "diaster"),
    Method("grd", "a causal model: learned masks choose the causes of the reward",
           "Zhang et al., GRD, NeurIPS 2023 (after the code, not the paper)", TRANSITION, Fit.DECODER_LOSS, "grd"),
    Method("rbt", "a transformer over the steps of a payment (at most 512), distilled into a model of single steps",
           "Tang et al., RBT, TMLR 2025 (after the code, not the paper)", TRANSITION, Fit.DECODER_LOSS, "rbt"),
    Method("arel", "attention over time and agents, one reward a step", "Xiao et al., AREL, AAMAS 2022",
           RAW, Fit.ALL_STEPS, "arel"),
    Method("stas", "attention over time, Shapley values over agents", "Chen et al., STAS, AAAI 2024",
           OBSERVATION_ACTION, Fit.ALL_STEPS, "stas"),
    Method("tar2", "attention over time and agents; each agent is paid a share of the return",
           "Kapoor et al., TAR2, 2025 (after the code, not the paper)", OBSERVATION_ACTION, Fit.ALL_STEPS, "tar2"),
    Method("lare-rd", "return decomposition on latent rewards", _LARE, FACTORS, Fit.ALL_STEPS),
    Method("lare-rrdu", "RRD-unbiased on latent rewards", _LARE, FACTORS, Fit.SAMPLED_STEPS_UNBIASED),
    Method("lare-linear", "linear regression on latent rewards", f"LaRe, appendix B; {_BAYES}",
           FACTORS, Fit.EVIDENCE, "linear"),
    Method("lare-bayes", "regression on latent rewards and, where returns require it, functions of them and of raw entries",
           _BAYES, FACTORS_AND_SCORED, Fit.EVIDENCE, "additive"),
    Method("bayes-history", "as bayes, and on changes of largest, smallest and last values: for scores that are no sum",
           _BAYES, SCORED_AND_HISTORY, Fit.EVIDENCE, "additive"),
    Method("lare-bayes-history", "as lare-bayes, and on changes of largest, smallest and last factors",
           _BAYES, FACTORS_SCORED_AND_HISTORY, Fit.EVIDENCE, "additive"),
    Method("bayes-progress", "changes of the return that the history predicts: for scores that are no sum",
           _PROGRESS, SCORED_AND_HISTORY, Fit.PREFIX_EVIDENCE, "additive"),
    Method("lare-bayes-progress", "as bayes-progress, from latent rewards and raw entries", _PROGRESS,
           FACTORS_SCORED_AND_HISTORY, Fit.PREFIX_EVIDENCE, "additive"),
    Method("lare-signs", "the sum of the factors, with the best signs", _LARE,
           FACTORS, Fit.SIGNS, "linear"),
    Method("llm-reward", "the reward that the language model wrote; nothing is fitted",
           "LaRe, appendix F.4; Ma et al., Eureka, ICLR 2024", FACTORS, reward=Reward.DESIGNED),
    Method("lare-rd-shared", "lare-rd, with the mean over agents for each", _LARE,
           FACTORS, Fit.ALL_STEPS, shared=True),
):
    register_method(_method)

FACTORS_ALONE = replace(METHODS["lare-linear"], decoder="additive")
"""How factors explain returns, with their shapes and pairs, and without raw features. It is not registered."""
