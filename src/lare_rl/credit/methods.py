"""The table of methods: all published ways to assign credit, as inputs + fit + decoder.

A *method* determines the rewards that the algorithm is trained on. `inputs` names what the decoder reads, `fit` the way it is fitted
to returns, and `decoder` its kind. `dense` and `episodic` fit nothing: `dense` trains on the true rewards, `episodic` on the
return, which is the reward of the last step. A method works for a single agent and for several, unless its row says otherwise.

`register_method` adds a method, for this package and for plugins alike.
"""

from lare_rl.credit.decoders import DECODERS
from lare_rl.credit.input_names import InputNames
from lare_rl.credit.method import Fit, Method, Reward
from lare_rl.util.plugins import Registry

__all__ = ["METHODS", "Fit", "Method", "Reward", "register_method"]


METHODS = Registry[Method]("method")


def register_method(method: Method) -> None:
    """Add a method, by whose name `lare-rl train --method` and `CreditAssigner` then find it.

    Raises:
        LareError: another method has this name, or its decoder is not registered.
    """
    DECODERS.find(method.decoder)
    METHODS.register(method.name, method)


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
