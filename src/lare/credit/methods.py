"""THE table: every published way to assign credit, as encoder + fit + decoder.

A *method* says what the algorithm is trained on. `encoder` is what the decoder sees of a step, `fit` how it is fitted to
returns, `decoder` what it is. The two ends of the table fit nothing: `dense` trains on the true rewards, `episodic` on the
return, paid at the last step. The rows serve one agent and many; those that need several agents say so.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from lare.errors import LareError, did_you_mean


class Encoder(StrEnum):
    """What the decoder sees of a step."""

    RAW = "raw"
    """As published for RD and RRD: [s, a, s - s'] of a single agent, the next observation of each of many."""
    STATE_ACTION = "state and action"
    """[s, a]."""
    NEXT = "next state and action"
    """[s', a]."""
    LATENT = "latent"
    """The factors z = phi(s, a), and nothing else."""
    LATENT_AND_NEXT = "latent, next state and action"
    """[z, s', a]."""


class Fit(StrEnum):
    """How the decoder is fitted to returns (equations in `losses.py`)."""

    ALL_STEPS = "all steps"
    """RD: the proxy rewards of all T steps of an episode against its return."""
    DRAWN_STEPS = "drawn steps"
    """RRD: K steps drawn from each episode."""
    DRAWN_STEPS_UNBIASED = "drawn steps, unbiased"
    """RRD-unbiased: the same, less the variance that the drawing adds."""
    SUBTRAJECTORIES = "two pieces of an episode"
    """Diaster: the two pieces of an episode that was cut somewhere (equations in `diaster.py`)."""
    EVIDENCE = "evidence"
    """In closed form, on all episodes (equations in `evidence.py`)."""
    SIGNS = "best signs"
    """The same, over the signs of a sum (equation in `closed_form.py`)."""

    @property
    def closed_form(self) -> bool:
        """Whether nothing descends a gradient."""
        return self in (Fit.EVIDENCE, Fit.SIGNS)

    @property
    def apart(self) -> bool:
        """Whether it is too expensive to go with every update of the algorithm, and goes between chunks of them."""
        return self is Fit.SUBTRAJECTORIES


class Decoder(StrEnum):
    """From what the encoder gives to proxy rewards."""

    STEP = "step"
    """An MLP on each step of each agent."""
    BOTTLENECK = "bottleneck"
    """The same behind a variational information bottleneck."""
    AREL = "arel"
    """Attention over time and agents; one reward a step for all agents."""
    STAS = "stas"
    """Attention over time, then over random coalitions of agents."""
    DIASTER = "diaster"
    """A recurrent model of pieces of an episode, and an MLP on each step that learns its differences."""
    LINEAR = "linear"
    """A weighted sum of what it is given."""
    ADDITIVE = "additive"
    """A weighted sum of that, of functions of each number in it, and of pairs of factors (`basis.py`)."""


class Reward(StrEnum):
    """What the algorithm is trained on."""

    TRUE = "true"
    EPISODIC = "episodic"
    PROXY = "proxy"
    """What the decoder says."""
    UNIFORM = "uniform"
    """The mean reward of the episode, between the lowest and the highest so far (of many agents: of those stored)."""
    DESIGNED = "designed"
    """What a reward function of the language model says."""


@dataclass(frozen=True)
class Method:
    """One row: a published name."""

    name: str
    reward: Reward
    encoder: Encoder | None
    fit: Fit | None
    summary: str
    source: str
    decoder: Decoder = Decoder.STEP
    shared: bool = False
    """Whether every agent gets the mean of all agents' proxy rewards: credit over time alone."""

    @property
    def has_proxy(self) -> bool:
        """Whether it gives every step a reward of its own making."""
        return self.reward not in (Reward.TRUE, Reward.EPISODIC)

    @property
    def in_units(self) -> bool:
        """Whether its rewards are in the unit of the true ones: they are fitted to add up to returns."""
        return self.reward is Reward.PROXY

    @property
    def latent(self) -> bool:
        """Whether it needs a function that a language model wrote."""
        return self.encoder in (Encoder.LATENT, Encoder.LATENT_AND_NEXT)

    @property
    def descends(self) -> bool:
        """Whether its decoder is fitted by gradient descent."""
        return self.fit is not None and not self.fit.closed_form

    @property
    def settings(self) -> frozenset[str]:
        """Which of the decoder's settings (`CreditSettings`) make a difference."""
        of_descent = DESCENT | OF_DECODER[self.decoder] if self.descends else frozenset()
        return of_descent | (OF_FIT[self.fit] if self.fit is not None else frozenset())

    @property
    def kind(self) -> Literal["factors", "reward"]:
        """What a language model is asked for, where the encoder is its function."""
        return "reward" if self.reward is Reward.DESIGNED else "factors"

    @property
    def for_many_only(self) -> bool:
        """Whether it says nothing where there is a single agent."""
        return self.shared or self.whole_episodes

    @property
    def whole_episodes(self) -> bool:
        """Whether its decoder looks at whole episodes, all of one length."""
        return self.decoder in (Decoder.AREL, Decoder.STAS)

    @property
    def for_one_only(self) -> bool:
        """Whether it says nothing where there are many."""
        return self.decoder is Decoder.DIASTER


DESCENT = frozenset({"learning_rate", "weight_decay", "normalise"})
OF_FIT: dict[Fit, frozenset[str]] = {
    Fit.ALL_STEPS: frozenset({"score", "sum_form", "steps"}),
    Fit.DRAWN_STEPS: frozenset({"score", "sum_form", "steps", "drawn_steps"}),
    Fit.DRAWN_STEPS_UNBIASED: frozenset({"score", "sum_form", "steps", "drawn_steps"}),
    Fit.SUBTRAJECTORIES: frozenset({"episodes"}),
    Fit.EVIDENCE: frozenset({"score", "optimism"}),
    Fit.SIGNS: frozenset(),
}
OF_DECODER: dict[Decoder, frozenset[str]] = {
    Decoder.STEP: frozenset({"hidden"}),
    Decoder.BOTTLENECK: frozenset({"hidden", "encoder", "bottleneck", "divergence"}),
    Decoder.AREL: frozenset(),
    Decoder.STAS: frozenset(),
    Decoder.DIASTER: frozenset({"hidden"}),
}
"""Settings, by what reads them: whatever descends a gradient, each fit, each decoder."""

LARE = "Qu et al., LaRe, AAAI 2025"
RD = "Efroni et al., AAAI 2021; Arjona-Medina et al., RUDDER, 2019"
RRD = "Ren et al., RRD, ICLR 2022"
BAYES = "this package, docs/closed-form.md; Efroni et al., AAAI 2021; MacKay, 1992"
VIB = "Alemi et al., ICLR 2017; LaRe, appendix F.2"

TABLE = (
    Method("dense", Reward.TRUE, None, None, "the true reward of every step: the upper end", "-"),
    Method("episodic", Reward.EPISODIC, None, None, "the return, paid at the last step: the lower end", "-"),
    Method(
        "ircr",
        Reward.UNIFORM,
        None,
        None,
        "every step of an episode alike, between the worst and the best episode",
        "Gangwani et al., IRCR, NeurIPS 2020",
    ),
    Method("rd", Reward.PROXY, Encoder.RAW, Fit.ALL_STEPS, "return decomposition on raw features", RD),
    Method("rrd", Reward.PROXY, Encoder.RAW, Fit.DRAWN_STEPS, "randomized return decomposition", RRD),
    Method("rrdu", Reward.PROXY, Encoder.RAW, Fit.DRAWN_STEPS_UNBIASED, "RRD without the bias of the drawing", RRD),
    Method(
        "rrdu-next",
        Reward.PROXY,
        Encoder.NEXT,
        Fit.DRAWN_STEPS_UNBIASED,
        "rrdu on the next state and the action",
        RRD,
    ),
    Method(
        "rd-linear",
        Reward.PROXY,
        Encoder.NEXT,
        Fit.EVIDENCE,
        "linear regression on the next state and the action",
        BAYES,
        Decoder.LINEAR,
    ),
    Method(
        "bayes",
        Reward.PROXY,
        Encoder.NEXT,
        Fit.EVIDENCE,
        "regression on functions of each entry of the next state and the action",
        BAYES,
        Decoder.ADDITIVE,
    ),
    Method(
        "vib-rd", Reward.PROXY, Encoder.RAW, Fit.ALL_STEPS, "RD behind a bottleneck of its own", VIB, Decoder.BOTTLENECK
    ),
    Method(
        "vib-rrdu",
        Reward.PROXY,
        Encoder.RAW,
        Fit.DRAWN_STEPS_UNBIASED,
        "RRD-unbiased behind a bottleneck of its own",
        VIB,
        Decoder.BOTTLENECK,
    ),
    Method(
        "diaster",
        Reward.PROXY,
        Encoder.STATE_ACTION,
        Fit.SUBTRAJECTORIES,
        "differences of what pieces of an episode pay",
        "Lin et al., Diaster, AAAI 2024",
        Decoder.DIASTER,
    ),
    Method(
        "arel",
        Reward.PROXY,
        Encoder.RAW,
        Fit.ALL_STEPS,
        "attention over time and agents, one reward a step",
        "Xiao et al., AREL, AAMAS 2022",
        Decoder.AREL,
    ),
    Method(
        "stas",
        Reward.PROXY,
        Encoder.STATE_ACTION,
        Fit.ALL_STEPS,
        "attention over time, Shapley values over agents",
        "Chen et al., STAS, AAAI 2024",
        Decoder.STAS,
    ),
    Method("lare-rd", Reward.PROXY, Encoder.LATENT, Fit.ALL_STEPS, "return decomposition on latent rewards", LARE),
    Method("lare-rrdu", Reward.PROXY, Encoder.LATENT, Fit.DRAWN_STEPS_UNBIASED, "RRD-unbiased on latent rewards", LARE),
    Method(
        "lare-linear",
        Reward.PROXY,
        Encoder.LATENT,
        Fit.EVIDENCE,
        "linear regression on latent rewards",
        BAYES,
        Decoder.LINEAR,
    ),
    Method(
        "lare-bayes",
        Reward.PROXY,
        Encoder.LATENT_AND_NEXT,
        Fit.EVIDENCE,
        "regression on latent rewards and, where the returns ask for them, on functions of them and of raw features",
        BAYES,
        Decoder.ADDITIVE,
    ),
    Method(
        "lare-signs",
        Reward.PROXY,
        Encoder.LATENT,
        Fit.SIGNS,
        "without a reward model: the sum of the factors, with the best signs",
        LARE,
        Decoder.LINEAR,
    ),
    Method(
        "llm-reward",
        Reward.DESIGNED,
        Encoder.LATENT,
        None,
        "the reward that the language model wrote; nothing is fitted",
        "LaRe, appendix F.4; Ma et al., Eureka, ICLR 2024",
    ),
    Method(
        "lare-rd-shared",
        Reward.PROXY,
        Encoder.LATENT,
        Fit.ALL_STEPS,
        "lare-rd without credit among agents: all get their mean",
        LARE,
        shared=True,
    ),
)

METHODS = {method.name: method for method in TABLE}


def find_method(name: str) -> Method:
    """The row of that name.

    Raises:
        LareError: there is none; the message lists those there are.
    """
    if name in METHODS:
        return METHODS[name]
    raise LareError(f"no method {name!r}{did_you_mean(name, METHODS)}; the methods are {', '.join(METHODS)}")
