"""Which method and decoder settings go together, and with which task.

These are the rules of `lare_rl.train`, of `CreditAssigner` and of `pure_credit`.
"""

from collections.abc import Iterator

from lare_rl.algorithms.registry import Consumes
from lare_rl.config.train_config import CreditConfig
from lare_rl.credit.basis import MAX_RAW_FEATURES
from lare_rl.credit.closed_form import MAX_SIGNED_FACTORS
from lare_rl.credit.methods import Fit, Method, Reward
from lare_rl.credit.spec import CreditSpec
from lare_rl.errors import LareError
from lare_rl.latent.function import LatentFunction
from lare_rl.tasks.spec import ScoredObservation

__all__ = ["check_credit", "check_phi", "check_training"]


def check_credit(spec: CreditSpec, n_agents: int, *, discrete_actions: bool = True) -> None:
    """Raise `LareError` if a method or the settings of its decoder do not fit the task.

    Args:
        n_agents: the agents of all teams.
        discrete_actions: whether actions are discrete. True if it is not known.
    """
    if problem := next(_find_problems(spec, n_agents, discrete_actions), None):
        raise LareError(problem)


def _find_problems(spec: CreditSpec, n_agents: int, discrete_actions: bool) -> Iterator[str]:
    method, settings, kind, name = spec.method, spec.settings, spec.method.decoder_kind, spec.method.name
    if method.reward is Reward.DESIGNED and spec.scored_observation == "both":
        yield f"{name} is one reward for each step: set scored_observation to 'before' or 'after', not to 'both'"
    if spec.scale_rewards and method.has_proxy_rewards and not method.calibrated:
        yield f"scale_rewards divides by the size of returns, and rewards of {name} are not in their unit"
    if settings.exact == "spread" and spec.payments.window is not None:
        yield "exact = 'spread' needs steps that belong to one payment each, and paid_for gives a step to several: use exact = 'last'"
    if method.single_agent_only and n_agents > 1:
        yield f"{name} assigns credit to a single agent, and the task has {n_agents} agents"
    if method.multi_agent_only and n_agents == 1:
        yield f"{name} assigns credit among agents, and the task has a single agent"
    if kind.whole_episodes and not spec.payments.only_at_end:
        yield f"{name} reads whole episodes, and the task pays before their end: use a method that reads steps"
    if kind.whole_episodes and not spec.fixed_length:
        yield f"{name} reads whole episodes of one length: use it with `lare_rl.train` on particle tasks"
    longest = spec.payments.longest_segment(spec.max_steps)
    if kind.longest_segment is not None and longest > kind.longest_segment:
        yield (
            f"{name} reads at most {kind.longest_segment} steps of one payment, and the task pays for up to {longest}: use rudder, or "
            "payments"
        )
    if kind.predicts_actions and not discrete_actions:
        yield f"{name} learns which of its actions an agent took, and the task has continuous ones: use stas"
    if "sampled_steps" in method.settings and not spec.fixed_length and settings.batch_steps < settings.sampled_steps:
        yield (
            f"the decoder has batch_steps = {settings.batch_steps}, less than sampled_steps = {settings.sampled_steps} of one episode: "
            "use more batch_steps"
        )
    n_raw = spec.basis.n_raw
    has_no_fit = n_raw > MAX_RAW_FEATURES and not spec.basis.n_features
    if settings.score == "average" and "score" in method.settings and has_no_fit and not spec.fixed_length:
        yield (
            f"{name} needs a fit in closed form for an average, which reads at most {MAX_RAW_FEATURES} raw features, and the task has "
            f"{n_raw}: use a method with phi, such as lare-bayes"
        )
    if method.fit in (Fit.EVIDENCE, Fit.PREFIX_EVIDENCE) and not method.needs_phi and n_raw > MAX_RAW_FEATURES:
        yield (
            f"{name} fits a weight to each of at most {MAX_RAW_FEATURES} raw features, and the task has {n_raw}: use lare-bayes, "
            "which fits weights to factors, or rrdu, a network"
        )
    if method.decoder in ("diaster", "rudder", "rbt") and not settings.hidden:
        yield f"{name} needs a hidden layer: the decoder has hidden = ()"


def check_training(config: CreditConfig) -> None:
    """Raise `LareError` if a method or its settings do not fit the task or the training loop."""
    for spec in config.credit_specs:
        check_credit(spec, config.env.n_agents, discrete_actions=config.env.discrete)
    method, max_steps, rollout_steps = config.method, config.env.max_steps, config.rollout_steps
    if method.multi_agent_only and config.team_level:
        raise LareError(f"{method.name} assigns credit among agents, and the task has credit_scope = 'state'")
    if method.decoder_kind.whole_episodes and rollout_steps % max_steps:
        raise LareError(
            f"{method.name} reads whole episodes: rollout_steps = {rollout_steps} is not a multiple of their length, {max_steps}"
        )
    if config.is_exact and len(config.env.teams) > 1 and config.env.agents_leave:
        raise LareError(
            "exact adds to the rewards of an episode's last step, at which a team of several may have left: use exact = 'no'"
        )
    is_cut = not config.has_fixed_segments or rollout_steps % config.longest_segment
    if config.is_exact and config.credit.exact == "spread" and config.consumes is Consumes.ROLLOUTS and is_cut:
        raise LareError(
            f"exact = 'spread' pays at all steps of an episode, and those in an earlier rollout (rollout_steps = {rollout_steps}) are "
            "paid already: use exact = 'last'"
        )
    if config.consumes is not Consumes.ROLLOUTS and method.uses_gradient and config.credit.exact != "no":
        raise LareError(
            "exact needs proxy rewards that stay the same during an iteration, and the updates of an off-policy algorithm change "
            f"those of {method.name}: use bayes or lare-bayes, or the algorithms ppo or ippo"
        )


def check_phi(method: Method, phi: LatentFunction | None, scored_observation: ScoredObservation) -> None:
    """Raise `LareError` if a method cannot use a latent function, or if it needs one and there is none."""
    name = method.name
    if phi is None:
        if method.needs_phi:
            raise LareError(f"{name} needs a phi; bayes, rd and rrdu need none")
        return
    if not method.needs_phi:
        raise LareError(f"{name} needs no phi: leave it out, or use lare-bayes")
    if method.phi_kind != "reward" and phi.kind != method.phi_kind:
        # A reward that was written by hand does not name its kind.
        raise LareError(f"{name} needs a phi of the kind {method.phi_kind!r}, and this one is of the kind {phi.kind!r}")
    n_factors = phi.n_factors(scored_observation)
    if method.reward is Reward.DESIGNED and n_factors != 1:
        raise LareError(
            f"{name} needs a function with one array, the reward, and this one has {n_factors}: "
            "lare-rl design TASK --kind reward writes one"
        )
    if method.fit is Fit.SIGNS and n_factors > MAX_SIGNED_FACTORS:
        raise LareError(f"{name} tries all signs of at most {MAX_SIGNED_FACTORS} factors, and there are {n_factors}")
