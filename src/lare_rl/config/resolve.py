"""Decide all settings of a run, and check that settings, method, algorithm and task go together."""

from lare_rl.algorithms.registry import ALGORITHMS, Algorithm, Consumes
from lare_rl.config.defaults import apply_defaults, choose_algorithm
from lare_rl.config.effective import ineffective_names, needs_replay
from lare_rl.config.settings import ResolvedSettings, Settings
from lare_rl.config.validity import check_credit
from lare_rl.credit.methods import find_method
from lare_rl.data.replay import required_capacity
from lare_rl.envs.families import find_score, load_env_spec
from lare_rl.envs.interface import EnvSpec
from lare_rl.errors import LareError
from lare_rl.tasks.spec import TaskSpec

__all__ = ["resolve"]


def resolve(settings: Settings, task: TaskSpec) -> ResolvedSettings:
    """Fill in the settings that are None, by the task, and check all settings.

    Raises:
        LareError: method, algorithm and task do not go together, or the steps are not a multiple of an iteration's.
    """
    if task.team is not None:
        raise LareError(f"{task.name} is one team of {task.environment}: train the task that has both")
    env = load_env_spec(task)
    _check_algorithm(ALGORITHMS[choose_algorithm(settings.algorithm, env)], task, env)
    resolved = _normalise(apply_defaults(settings, env), task, env)

    method, team_level = find_method(resolved.method), task.judged_from == "state"
    n_state_features = env.state_size + env.n_agents * env.action_size
    check_credit(
        method,
        resolved.credit,
        n_agents=env.n_agents,
        n_raw_features=n_state_features if team_level else env.observation_size + env.action_size,
        factor_inputs=resolved.factor_inputs(task),
        team_level=team_level,
        fixed_length=env.fixed_length,
        scale_rewards=resolved.scale_rewards,
    )
    if method.needs_whole_episodes and resolved.rollout_steps % env.max_steps:
        raise LareError(
            f"{method.name} reads whole episodes: rollout_steps = {resolved.rollout_steps} is not a multiple of their length, "
            f"{env.max_steps}"
        )
    _check_size(resolved, task, env)
    return resolved


def _normalise(resolved: ResolvedSettings, task: TaskSpec, env: EnvSpec) -> ResolvedSettings:
    """Give settings that make no difference one value, so that equal runs have equal settings."""
    changes = {}
    if resolved.judges == task.judges:
        changes["judges"] = None
    if "first_fit" in ineffective_names(resolved):
        changes["first_fit"] = None
    score = resolved.credit.score
    if env.fixed_length:  # sum and mean have the same decoder
        score = "auto"
    elif score == "auto":
        score = find_score(task) or score
    changes["credit"] = resolved.credit.model_copy(update={"score": score})
    return resolved.model_copy(update=changes)


def _check_algorithm(algorithm: Algorithm, task: TaskSpec, env: EnvSpec) -> None:
    """Raise `LareError` if an algorithm cannot train on a task."""
    name = algorithm.name
    if env.n_agents > 1 and not algorithm.multi_agent:
        raise LareError(f"{name} trains a single agent, and {task.name} has {env.n_agents}: use ippo or qmix")
    if env.n_agents == 1 and not algorithm.single_agent:
        raise LareError(f"{name} trains many agents, and {task.name} has one: use td3 or ppo")
    if len(env.teams) > 1 and not algorithm.multi_team:
        raise LareError(f"{name} trains one team, and {task.name} has {len(env.teams)}: use ippo")
    if env.discrete and not algorithm.discrete:
        raise LareError(f"{name} needs continuous actions, and those of {task.name} are discrete: use ppo")
    if not env.discrete and not algorithm.continuous:
        raise LareError(f"{name} needs discrete actions, and those of {task.name} are continuous: use ppo or ippo")


def _check_size(resolved: ResolvedSettings, task: TaskSpec, env: EnvSpec) -> None:
    """Raise `LareError` if a run is too short, or if the replay could not hold the steps of an iteration."""
    if 2 * resolved.steps < env.max_steps:
        raise LareError(
            f"steps = {resolved.steps} are too few: an episode of {task.name} takes up to {env.max_steps}, and a run at least half "
            "of that"
        )
    required = required_capacity(resolved.rollout_steps, env.max_steps) * resolved.environments
    if needs_replay(resolved) and resolved.capacity < required:
        data = "a rollout" if ALGORITHMS[resolved.algorithm].consumes is Consumes.ROLLOUTS else "an iteration"
        raise LareError(f"capacity = {resolved.capacity} is too small: {data} of {task.name} takes up to {required}")
