"""THE table: every published way to assign credit, as encoder + fit + decoder.

A *method* determines the rewards that the algorithm is trained on. `encoder` names the inputs of the decoder, `fit` the way it is
fitted to returns, and `decoder` its kind. `dense` and `episodic` fit nothing: `dense` trains on the true rewards, `episodic` on
the return, paid at the last step. A method works for one agent and for many, unless its row says otherwise.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from lare_rl.errors import LareError, did_you_mean


class Encoder(StrEnum):
    """The inputs of the decoder for a step."""

    RAW = "raw"
    """As published for RD and RRD: [s, a, s - s'] of a single agent, or the next observation of each of many agents."""
    STATE_ACTION = "state and action"
    """[s, a]."""
    NEXT = "next state and action"
    """[s', a]."""
    JUDGED = "judged state and action"
    """[s', a], [s, a] or [s, s', a]: whichever states the task judges a step by."""
    LATENT = "latent"
    """The factors z, and nothing else."""
    LATENT_AND_JUDGED = "latent, judged state and action"
    """The factors z, and the entries of `JUDGED`."""


class Fit(StrEnum):
    """How the decoder is fitted to returns (equations in `losses.py`)."""

    ALL_STEPS = "all steps"
    """RD: the proxy rewards of all T steps of an episode against its return."""
    DRAWN_STEPS = "drawn steps"
    """RRD: K steps drawn from each episode."""
    DRAWN_STEPS_UNBIASED = "drawn steps, unbiased"
    """RRD-unbiased: as RRD, minus the variance that the drawing adds."""
    SUBTRAJECTORIES = "two pieces of an episode"
    """Diaster: the two pieces of an episode that is cut at a random step (equations in `diaster.py`)."""
    EVIDENCE = "evidence"
    """In closed form, on all episodes (equations in `evidence.py`)."""
    SIGNS = "best signs"
    """In closed form: the best signs of a sum of the factors (equation in `closed_form.py`)."""

    @property
    def closed_form(self) -> bool:
        """Whether the fit needs no gradient descent."""
        return self in (Fit.EVIDENCE, Fit.SIGNS)

    @property
    def draws_steps(self) -> bool:
        """Whether an update reads K steps of each episode, and not all of them."""
        return "drawn_steps" in OF_FIT[self]

    @property
    def apart(self) -> bool:
        """Whether the fit is too expensive for every update of the algorithm, and so runs between chunks of updates."""
        return self is Fit.SUBTRAJECTORIES


class Decoder(StrEnum):
    """The kinds of decoder, from the encoder's output to proxy rewards."""

    STEP = "step"
    """An MLP on each step of each agent."""
    BOTTLENECK = "bottleneck"
    """The same MLP after a variational information bottleneck."""
    AREL = "arel"
    """Attention over time and agents; one reward a step for all agents."""
    STAS = "stas"
    """Attention over time, then over random coalitions of agents."""
    DIASTER = "diaster"
    """A recurrent model of pieces of an episode, and an MLP on each step that learns its differences."""
    LINEAR = "linear"
    """A weighted sum of the inputs."""
    ADDITIVE = "additive"
    """A weighted sum of the inputs, of functions of each input, and of pairs of inputs (`basis.py`)."""


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
    """One row: a published name."""

    name: str
    reward: Reward
    encoder: Encoder | None
    fit: Fit | None
    summary: str
    source: str
    decoder: Decoder = Decoder.STEP
    shared: bool = False
    """Whether every agent gets the mean of all agents' proxy rewards: credit over time, but not among agents."""

    @property
    def has_proxy(self) -> bool:
        """Whether it computes a proxy reward for every step."""
        return self.reward not in (Reward.TRUE, Reward.EPISODIC)

    @property
    def in_reward_units(self) -> bool:
        """Whether its rewards are in the unit of the true ones: they are fitted to add up to returns."""
        return self.reward is Reward.PROXY

    @property
    def latent(self) -> bool:
        """Whether it needs a function that a language model wrote."""
        return self.encoder in (Encoder.LATENT, Encoder.LATENT_AND_JUDGED)

    @property
    def follows_judges(self) -> bool:
        """Whether it matters by which states the task judges a step."""
        return self.latent or self.encoder is Encoder.JUDGED

    @property
    def descends(self) -> bool:
        """Whether its decoder is fitted by gradient descent."""
        return self.fit is not None and not self.fit.closed_form

    @property
    def settings(self) -> frozenset[str]:
        """The settings of the decoder (`CreditSettings`) that the method reads."""
        of_descent = DESCENT | OF_DECODER[self.decoder] if self.descends else frozenset()
        return of_descent | (OF_FIT[self.fit] if self.fit is not None else frozenset())

    @property
    def kind(self) -> Literal["factors", "reward"]:
        """The kind of function that a language model is asked for, if the method needs one."""
        return "reward" if self.reward is Reward.DESIGNED else "factors"

    @property
    def for_many_only(self) -> bool:
        """Whether it needs several agents."""
        return self.shared or self.whole_episodes

    @property
    def whole_episodes(self) -> bool:
        """Whether its decoder looks at whole episodes, all of one length."""
        return self.decoder in (Decoder.AREL, Decoder.STAS)

    @property
    def for_one_only(self) -> bool:
        """Whether it works for a single agent only."""
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
"""The settings that are read by every fit by gradient descent, by each fit, and by each decoder."""

LARE = "Qu et al., LaRe, AAAI 2025"
RD = "Efroni et al., AAAI 2021; Arjona-Medina et al., RUDDER, 2019"
RRD = "Ren et al., RRD, ICLR 2022"
BAYES = "this package, docs/closed-form.md; Efroni et al., AAAI 2021; MacKay, 1992"
VIB = "Alemi et al., ICLR 2017; LaRe, appendix F.2"

TABLE = (
    Method("dense", Reward.TRUE, None, None, "the true reward of every step: the upper reference", "-"),
    Method("episodic", Reward.EPISODIC, None, None, "the return, paid at the last step: the lower reference", "-"),
    Method(
        "ircr",
        Reward.UNIFORM,
        None,
        None,
        "the same reward for all steps of an episode, from 0 (the worst episode) to 1 (the best)",
        "Gangwani et al., IRCR, NeurIPS 2020",
    ),
    Method("rd", Reward.PROXY, Encoder.RAW, Fit.ALL_STEPS, "return decomposition on raw features", RD),
    Method("rrd", Reward.PROXY, Encoder.RAW, Fit.DRAWN_STEPS, "randomized return decomposition", RRD),
    Method("rrdu", Reward.PROXY, Encoder.RAW, Fit.DRAWN_STEPS_UNBIASED, "RRD without the bias of drawing steps", RRD),
    Method(
        "rrdu-next",
        Reward.PROXY,
        Encoder.NEXT,
        Fit.DRAWN_STEPS_UNBIASED,
        "rrdu on the next state and the action",
        f"{RRD}; these inputs: this package",
    ),
    Method(
        "rd-linear",
        Reward.PROXY,
        Encoder.JUDGED,
        Fit.EVIDENCE,
        "linear regression on the state and the action",
        BAYES,
        Decoder.LINEAR,
    ),
    Method(
        "bayes",
        Reward.PROXY,
        Encoder.JUDGED,
        Fit.EVIDENCE,
        "regression on functions of the entries of the state and the action",
        BAYES,
        Decoder.ADDITIVE,
    ),
    Method(
        "vib-rd",
        Reward.PROXY,
        Encoder.RAW,
        Fit.ALL_STEPS,
        "RD after a learned information bottleneck",
        VIB,
        Decoder.BOTTLENECK,
    ),
    Method(
        "vib-rrdu",
        Reward.PROXY,
        Encoder.RAW,
        Fit.DRAWN_STEPS_UNBIASED,
        "RRD-unbiased after a learned information bottleneck",
        VIB,
        Decoder.BOTTLENECK,
    ),
    Method(
        "diaster",
        Reward.PROXY,
        Encoder.STATE_ACTION,
        Fit.SUBTRAJECTORIES,
        "differences between predicted rewards of pieces of an episode",
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
        f"LaRe, appendix B; the fit: {BAYES}",
        Decoder.LINEAR,
    ),
    Method(
        "lare-bayes",
        Reward.PROXY,
        Encoder.LATENT_AND_JUDGED,
        Fit.EVIDENCE,
        "regression on latent rewards and, if the returns require them, on functions of them and of raw entries",
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
        "lare-rd without credit among agents: each agent gets the mean of all",
        LARE,
        shared=True,
    ),
)

METHODS = {method.name: method for method in TABLE}


def find_method(name: str) -> Method:
    """The row of that name.

    Raises:
        LareError: no method has this name; the message lists all methods.
    """
    if name in METHODS:
        return METHODS[name]
    raise LareError(f"no method {name!r}{did_you_mean(name, METHODS)}; the methods are {', '.join(METHODS)}")
