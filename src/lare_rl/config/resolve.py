"""Which settings, method, algorithm and task go together."""

from lare_rl.algorithms.table import ALGORITHMS, Algorithm, Consumes
from lare_rl.config.defaults import algorithm_of, resolve
from lare_rl.config.settings import ResolvedSettings, Settings
from lare_rl.credit.basis import MOST_ENTRIES
from lare_rl.credit.methods import Decoder, Encoder, Fit, Method, Reward, find_method
from lare_rl.data.replay import room
from lare_rl.envs.families import env_spec, known_score
from lare_rl.envs.interface import EnvSpec
from lare_rl.errors import LareError
from lare_rl.tasks.spec import TaskSpec


def decide(settings: Settings, task: TaskSpec) -> ResolvedSettings:
    """Fill in the settings that are None, by the task, and check all settings.

    Raises:
        LareError: method, algorithm and task do not go together, or the steps are not a multiple of an iteration's.
    """
    if task.team is not None:
        raise LareError(f"{task.name} is one team of {task.environment}: train the task that has both")
    env = env_spec(task)
    check_algorithm(ALGORITHMS[algorithm_of(settings.algorithm, env)], task, env)
    resolved = resolve(settings, env)
    if resolved.judges == task.judges:  # the task's own value makes no difference
        resolved = resolved.model_copy(update={"judges": None})
    if "first_fit" in resolved.idle:
        resolved = resolved.model_copy(update={"first_fit": None})
    score = resolved.credit.score
    if env.fixed_length:  # the form of the score makes no difference
        score = "auto"
    elif score == "auto":
        score = known_score(task) or score
    resolved = resolved.model_copy(update={"credit": resolved.credit.model_copy(update={"score": score})})
    check_method(resolved, task, env)
    check_room(resolved, task, env)
    return resolved


def check_algorithm(row: Algorithm, task: TaskSpec, env: EnvSpec) -> None:
    """Raise `LareError` if an algorithm cannot train on a task."""
    many = env.agents > 1
    if not (row.many_agents if many else row.one_agent):
        raise LareError(
            f"{row.name} is for {'a single agent' if many else 'many agents'}, and {task.name} is a task "
            f"of {'many' if many else 'one'}"
        )
    if len(env.teams) > 1 and not row.many_teams:
        raise LareError(f"{row.name} trains one team, and {task.name} has {len(env.teams)}: ippo trains several")
    if env.discrete and not row.discrete:
        raise LareError(f"{row.name} needs continuous actions, and those of {task.name} are discrete: use ppo")
    if not env.discrete and not row.continuous:
        raise LareError(f"{row.name} needs discrete actions, and those of {task.name} are continuous")


def check_method(resolved: ResolvedSettings, task: TaskSpec, env: EnvSpec) -> None:
    """Raise `LareError` if a method cannot assign credit in a task."""
    method, many = find_method(resolved.method), env.agents > 1
    if method.reward is Reward.DESIGNED and resolved.judged_by(task) == "both":
        raise LareError(f"{method.name} is one reward a step: it judges the observation before or after, not both")
    if resolved.scale_rewards and method.has_proxy and not method.in_reward_units:
        raise LareError(
            f"scale_rewards divides by the size of returns, and the rewards of {method.name} are not in their unit"
        )
    if method.for_one_only and many:
        raise LareError(f"{method.name} assigns credit to a single agent, and {task.name} is a task of many")
    if method.for_many_only and not many:
        raise LareError(f"{method.name} assigns credit among agents, and {task.name} is a task of one")
    if method.for_many_only and task.judged_from == "state":
        raise LareError(f"{method.name} assigns credit among agents, and {task.name} is judged from the global state")
    if method.whole_episodes and not env.fixed_length:
        raise LareError(
            f"{method.name} looks at whole episodes of one length, and so it trains on LaRe's particle tasks only: episodes of "
            f"{task.name} could differ in length"
        )
    if method.whole_episodes and resolved.rollout_steps % env.max_steps:
        raise LareError(
            f"{method.name} looks at whole episodes: rollout_steps = {resolved.rollout_steps} is not a multiple of their length, "
            f"{env.max_steps}"
        )
    check_credit(resolved, method, task, env)
    if resolved.reflect_every is not None and method.encoder is not Encoder.LATENT_AND_JUDGED:
        raise LareError(
            f"reflect_every is for lare-bayes, whose decoder is fitted at once when phi changes; the method is {method.name}"
        )


def check_credit(resolved: ResolvedSettings, method: Method, task: TaskSpec, env: EnvSpec) -> None:
    """Raise `LareError` if the settings of a decoder are impossible for the task."""
    credit = resolved.credit
    if "drawn_steps" in method.settings and not env.fixed_length and credit.steps < credit.drawn_steps:
        raise LareError(
            f"credit.steps = {credit.steps} is less than credit.drawn_steps = {credit.drawn_steps}, of one episode"
        )
    of_state = task.judged_from == "state"
    entries = (env.state_size + env.agents * env.action_size) if of_state else env.observation_size + env.action_size
    if method.fit is Fit.EVIDENCE and not method.latent and entries > MOST_ENTRIES:
        raise LareError(
            f"{method.name} fits a weight to each of at most {MOST_ENTRIES} entries, and {task.name} has {entries}: "
            "lare-bayes fits weights to the factors of phi, rrdu trains a network"
        )
    if method.decoder is Decoder.DIASTER and not credit.hidden:
        raise LareError(f"credit.hidden is empty, and {method.name} needs a hidden layer")


def check_room(resolved: ResolvedSettings, task: TaskSpec, env: EnvSpec) -> None:
    """Raise `LareError` if the replay could not hold the steps of an iteration, or if a run is too short."""
    longest = env.max_steps
    if 2 * resolved.steps < longest:
        raise LareError(
            f"steps = {resolved.steps} are too few: an episode of {task.name} takes up to {longest}, "
            "and a run at least half of that"
        )
    needed = room(resolved.rollout_steps, longest) * resolved.environments
    if resolved.rereads and resolved.capacity < needed:
        what = "a rollout" if ALGORITHMS[resolved.algorithm].consumes is Consumes.ROLLOUTS else "an iteration"
        raise LareError(f"capacity = {resolved.capacity} is too small: {what} of {task.name} takes up to {needed}")
