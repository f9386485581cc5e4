"""Which method and decoder settings go together, and with which task.

These are the rules of `lare_rl.train`, of `CreditAssigner` and of `pure_credit`.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from lare_rl.credit.basis import MAX_RAW_FEATURES
from lare_rl.credit.closed_form import MAX_SIGNED_FACTORS
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import Fit, Method, Reward
from lare_rl.errors import LareError
from lare_rl.tasks.payments import PAID_AT_END, PaymentRule
from lare_rl.tasks.spec import ScoredObservation

__all__ = ["CreditContext", "check_credit", "check_factors"]


@dataclass(frozen=True, kw_only=True)
class CreditContext:
    """What a method and the settings of its decoder must fit: the task and the training loop."""

    n_agents: int
    n_raw_features: int
    """Entries of an observation (of the global state, if `team_level`) and of the actions with it."""
    scored_observation: ScoredObservation = "after"
    """Which observations of a step phi reads."""
    team_level: bool = False
    """Whether credit is assigned to the team's global state instead of each agent."""
    fixed_length: bool = False
    """Whether every episode has the same number of steps."""
    scale_rewards: bool = False
    """Whether rewards are divided by the size of returns."""
    payments: PaymentRule = PAID_AT_END
    discrete_actions: bool = True
    max_steps: int | None = None
    """The number of steps of the longest episode. None if it is not known."""
    rollout_steps: int | None = None
    """The number of steps of an iteration. None if there are no iterations."""
    off_policy: bool = False
    """Whether the decoder is fitted between the updates of an iteration."""
    step_at_a_time: bool = False
    """Whether the reward of a step is computed from this step alone."""


def check_credit(method: Method, credit: CreditSettings, context: CreditContext) -> None:
    """Raise `LareError` if a method or the settings of its decoder do not fit the context."""
    for find_problems in (_reward_problems, _agent_problems, _episode_problems, _decoder_problems):
        for problem in find_problems(method, credit, context):
            raise LareError(problem)


def _reward_problems(method: Method, credit: CreditSettings, context: CreditContext) -> Iterator[str]:
    name = method.name
    if context.step_at_a_time:
        reads_history = method.decoder_kind.whole_episodes or (
            method.inputs is not None and "history" in method.inputs.names
        )
        if method.reward not in (Reward.PROXY, Reward.DESIGNED) or reads_history:
            yield f"{name} does not compute the reward of a step from this step alone: use bayes or lare-bayes"
        if credit.exact not in ("auto", "no"):
            yield "exact needs the other steps of an episode: leave it out"
    if method.reward is Reward.DESIGNED and context.scored_observation == "both":
        yield f"{name} is one reward for each step: set scored_observation to 'before' or 'after', not to 'both'"
    if context.scale_rewards and method.has_proxy_rewards and not method.calibrated:
        yield f"scale_rewards divides by the size of returns, and rewards of {name} are not in their unit"
    if credit.exact == "spread" and context.payments.window is not None:
        yield "exact = 'spread' needs steps that belong to one payment each, and paid_for gives a step to several: use exact = 'last'"
    if context.off_policy and method.uses_gradient and credit.exact != "no":
        yield (
            f"exact needs proxy rewards that stay the same during an iteration, and the updates of an off-policy algorithm change "
            f"those of {name}: use bayes or lare-bayes, or the algorithms ppo or ippo"
        )


def _agent_problems(method: Method, credit: CreditSettings, context: CreditContext) -> Iterator[str]:
    name = method.name
    if method.single_agent_only and context.n_agents > 1:
        yield f"{name} assigns credit to a single agent, and the task has {context.n_agents} agents"
    if method.multi_agent_only and context.n_agents == 1:
        yield f"{name} assigns credit among agents, and the task has a single agent"
    if method.multi_agent_only and context.team_level:
        yield f"{name} assigns credit among agents, and the task has credit_scope = 'state'"


def _episode_problems(method: Method, credit: CreditSettings, context: CreditContext) -> Iterator[str]:
    name, max_steps, rollout_steps = method.name, context.max_steps, context.rollout_steps
    if method.decoder_kind.whole_episodes and not context.fixed_length:
        yield f"{name} reads whole episodes of one length: use it with `lare_rl.train` on particle tasks"
    if method.decoder_kind.whole_episodes and not context.payments.only_at_end:
        yield f"{name} reads whole episodes, and the task pays before their end: use a method that reads steps"
    if method.decoder_kind.whole_episodes and rollout_steps and max_steps and rollout_steps % max_steps:
        yield f"{name} reads whole episodes: rollout_steps = {rollout_steps} is not a multiple of their length, {max_steps}"
    longest = method.decoder_kind.longest_segment
    if longest is not None and max_steps is not None and context.payments.longest_segment(max_steps) > longest:
        yield (
            f"{name} reads at most {longest} steps of one payment, and the task pays for up to "
            f"{context.payments.longest_segment(max_steps)}: use rudder, or payments"
        )


def _decoder_problems(method: Method, credit: CreditSettings, context: CreditContext) -> Iterator[str]:
    name, n_raw = method.name, context.n_raw_features
    if method.decoder_kind.predicts_actions and not context.discrete_actions:
        yield f"{name} learns which of its actions an agent took, and the task has continuous ones: use stas"
    if "sampled_steps" in method.settings and not context.fixed_length and credit.steps < credit.sampled_steps:
        yield (
            f"the decoder has steps = {credit.steps}, less than sampled_steps = {credit.sampled_steps} of one episode: use more steps"
        )
    if method.fit in (Fit.EVIDENCE, Fit.PREFIX_EVIDENCE) and not method.needs_phi and n_raw > MAX_RAW_FEATURES:
        yield (
            f"{name} fits a weight to each of at most {MAX_RAW_FEATURES} raw features, and the task has {n_raw}: use lare-bayes, "
            "which fits weights to factors, or rrdu, a network"
        )
    if method.decoder in ("diaster", "rudder", "rbt") and not credit.hidden:
        yield f"{name} needs a hidden layer: the decoder has hidden = ()"


def check_factors(method: Method, n_factors: int) -> None:
    """Raise `LareError` if a method cannot use a function with this number of factors."""
    if method.reward is Reward.DESIGNED and n_factors != 1:
        raise LareError(
            f"{method.name} needs a function with one array, the reward, and this one has {n_factors}: "
            "lare-rl design TASK --kind reward writes one"
        )
    if method.fit is Fit.SIGNS and n_factors > MAX_SIGNED_FACTORS:
        raise LareError(
            f"{method.name} tries all signs of at most {MAX_SIGNED_FACTORS} factors, and there are {n_factors}"
        )
