"""Which method and decoder settings go together, and with which task.

These are the rules of `lare_rl.train`, of `CreditAssigner` and of `pure_credit`.
"""

from lare_rl.credit.basis import MAX_RAW_FEATURES
from lare_rl.credit.closed_form import MAX_SIGNED_FACTORS
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decoders import DECODERS
from lare_rl.credit.methods import Fit, Method, Reward
from lare_rl.errors import LareError
from lare_rl.tasks.payments import PAID_AT_END, PaymentRule
from lare_rl.tasks.spec import ScoredObservation

__all__ = ["check_credit", "check_factors"]


def check_credit(
    method: Method,
    credit: CreditSettings,
    *,
    n_agents: int,
    n_raw_features: int,
    scored_observation: ScoredObservation = "after",
    team_level: bool = False,
    fixed_length: bool = False,
    scale_rewards: bool = False,
    payments: PaymentRule = PAID_AT_END,
    discrete_actions: bool = True,
    max_steps: int | None = None,
    rollout_steps: int | None = None,
    off_policy: bool = False,
    step_at_a_time: bool = False,
) -> None:
    """Raise `LareError` if a method or the settings of its decoder are impossible for a task.

    Args:
        n_raw_features: entries of an observation (of the global state, if `team_level`) and of the actions with it.
        scored_observation: which observations of a step phi reads.
        team_level: whether credit is assigned to the team's global state instead of each agent.
        fixed_length: whether every episode has the same number of steps.
        scale_rewards: whether rewards are divided by the size of returns.
        discrete_actions: whether the actions are discrete.
        max_steps: the number of steps of the longest episode, if that is known.
        rollout_steps: the number of steps of an iteration, if there are iterations.
        off_policy: whether the decoder is fitted between the updates of an iteration.
        step_at_a_time: whether the reward of a step is computed from this step alone.
    """
    name = method.name
    if step_at_a_time:
        reads_history = method.needs_whole_episodes or (method.inputs is not None and "history" in method.inputs.names)
        if method.reward not in (Reward.PROXY, Reward.DESIGNED) or reads_history:
            raise LareError(
                f"{name} does not compute the reward of a step from this step alone: use bayes or lare-bayes"
            )
        if credit.exact not in ("auto", "no"):
            raise LareError("exact needs the other steps of an episode: leave it out")
    if method.reward is Reward.DESIGNED and scored_observation == "both":
        raise LareError(
            f"{name} is one reward for each step: set scored_observation to 'before' or 'after', not to 'both'"
        )
    if scale_rewards and method.has_proxy_rewards and not method.calibrated:
        raise LareError(f"scale_rewards divides by the size of returns, and rewards of {name} are not in their unit")
    if method.single_agent_only and n_agents > 1:
        raise LareError(f"{name} assigns credit to a single agent, and the task has {n_agents} agents")
    if method.multi_agent_only and n_agents == 1:
        raise LareError(f"{name} assigns credit among agents, and the task has a single agent")
    if method.multi_agent_only and team_level:
        raise LareError(f"{name} assigns credit among agents, and the task has credit_scope = 'state'")
    if method.needs_whole_episodes and not fixed_length:
        raise LareError(f"{name} reads whole episodes of one length: use it with `lare_rl.train` on particle tasks")
    if method.needs_whole_episodes and not payments.only_at_end:
        raise LareError(
            f"{name} reads whole episodes, and the task pays before their end: use a method that reads steps"
        )
    if method.needs_whole_episodes and rollout_steps and max_steps and rollout_steps % max_steps:
        raise LareError(
            f"{name} reads whole episodes: rollout_steps = {rollout_steps} is not a multiple of their length, {max_steps}"
        )
    if off_policy and method.uses_gradient and credit.exact != "no":
        raise LareError(
            f"exact needs proxy rewards that stay the same during an iteration, and the updates of an off-policy algorithm change "
            f"those of {name}: use bayes or lare-bayes, or the algorithms ppo or ippo"
        )
    if DECODERS[method.decoder].predicts_actions and not discrete_actions:
        raise LareError(f"{name} learns which of its actions an agent took, and the task has continuous ones: use stas")
    longest = DECODERS[method.decoder].longest_segment
    if longest is not None and max_steps is not None and payments.longest_segment(max_steps) > longest:
        raise LareError(
            f"{name} reads at most {longest} steps of one payment, and the task pays for up to "
            f"{payments.longest_segment(max_steps)}: use rudder, or payments"
        )
    if "sampled_steps" in method.settings and not fixed_length and credit.steps < credit.sampled_steps:
        raise LareError(
            f"the decoder has steps = {credit.steps}, less than sampled_steps = {credit.sampled_steps} of one episode: use more steps"
        )
    if method.fit in (Fit.EVIDENCE, Fit.PREFIX_EVIDENCE) and not method.needs_phi and n_raw_features > MAX_RAW_FEATURES:
        raise LareError(
            f"{name} fits a weight to each of at most {MAX_RAW_FEATURES} raw features, and the task has {n_raw_features}: "
            "use lare-bayes, which fits weights to factors, or rrdu, a network"
        )
    if method.decoder in ("diaster", "rudder", "rbt") and not credit.hidden:
        raise LareError(f"{name} needs a hidden layer: the decoder has hidden = ()")


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
