"""Decide all settings of a run, and check that settings, method, algorithm and task go together."""

from typing import Any

from lare_rl.algorithms.registry import ALGORITHMS, Algorithm, Consumes, SequenceSettings
from lare_rl.config.effective import reads_old_steps, unused_names
from lare_rl.config.settings import ResolvedSettings, Settings
from lare_rl.config.train_config import make_train_config
from lare_rl.config.validity import check_training
from lare_rl.credit.decoder_settings import MULTI_AGENT_CREDIT, CreditSettings
from lare_rl.credit.methods import METHODS, Fit
from lare_rl.data.replay import required_capacity
from lare_rl.envs.families import find_score_key
from lare_rl.envs.interface import EnvSpec
from lare_rl.envs.placement import load_env_spec
from lare_rl.errors import LareError
from lare_rl.tasks.spec import TaskSpec
from lare_rl.util.rounding import round_up

__all__ = ["choose_algorithm", "fill_in", "resolve"]

MIN_EVALUATIONS = 5
"""Evaluations of a short run of an algorithm that consumes rollouts, by default."""


def resolve(settings: Settings, task: TaskSpec) -> ResolvedSettings:
    """Fill in the settings that are None, by the task, and check all settings.

    Raises `LareError` if method, algorithm and task do not go together.
    """
    if task.team is not None:
        raise LareError(f"{task.name} is one team of {task.environment}: train the task that has both")
    env = load_env_spec(task)
    _check_algorithm(ALGORITHMS[choose_algorithm(settings.algorithm, env)], task, env)
    resolved = fill_in(settings, task, env)
    config = make_train_config(task, resolved)
    check_training(config)
    monotonic = getattr(resolved.hyperparameters, "monotonic", None)
    if monotonic != getattr(ALGORITHMS[resolved.algorithm].settings, "monotonic", None):
        raise LareError(
            f"{resolved.algorithm}.monotonic = {monotonic}: use --algorithm {'qmix' if monotonic else 'vdn'}"
        )
    if resolved.overlap_collection and (env.is_jax or config.consumes is not Consumes.TRANSITIONS):
        raise LareError(
            f"overlap_collection needs td3, ddpg or sac and an environment on the host: remove it for {resolved.algorithm} on "
            f"{task.name}"
        )
    if resolved.overlap_collection and not resolved.warmup:
        raise LareError(
            f"overlap_collection updates before the first steps are stored: set {resolved.algorithm}.warmup to 1 or more"
        )
    _check_size(resolved, task, env)
    return resolved


def fill_in(settings: Settings, task: TaskSpec, env: EnvSpec) -> ResolvedSettings:
    """Fill in the settings that are None. `steps` and `evaluate_every` are rounded up to whole iterations."""
    return _normalise(_apply_defaults(settings, env), task, env)


def choose_algorithm(name: str | None, env: EnvSpec) -> str:
    """Return the requested algorithm, or the default one for an environment."""
    if name is not None:
        return name
    if env.n_agents == 1:
        return "ppo" if env.discrete else "td3"
    return "qmix" if env.state_size and env.masks_actions and len(env.teams) == 1 else "ippo"


def _apply_defaults(settings: Settings, env: EnvSpec) -> ResolvedSettings:
    name = choose_algorithm(settings.algorithm, env)
    algorithm = ALGORITHMS[name]
    defaults: dict[str, Any] = {
        "method": "lare-bayes",
        "steps": 1_000_000,
        "environments": 1,
        "rollout_steps": 50,
        "evaluate_every": 5000,
        "capacity": 1_000_000,
        "fit_every": 1,
        "fit_updates": 1,
        "evaluation_episodes": 10,
        "credit": {},
        **algorithm.run_defaults(env, settings.environments),
    }
    evaluate_iterations = defaults.pop("evaluate_iterations", None)
    values = defaults | {key: value for key, value in settings if value is not None and key not in ALGORITHMS}
    iteration = values["rollout_steps"] * values["environments"]

    n_iterations = max(1, round(defaults["steps"] / iteration))
    steps = round_up(settings.steps or n_iterations * iteration, iteration)
    n_iterations = evaluate_iterations or max(1, round(defaults["evaluate_every"] / iteration))
    if algorithm.consumes is Consumes.ROLLOUTS:
        n_iterations = min(n_iterations, max(1, steps // (MIN_EVALUATIONS * iteration)))
    evaluate_every = round_up(settings.evaluate_every or n_iterations * iteration, iteration)

    method = METHODS.find(values["method"])
    if settings.fit_updates is None and method.fit is Fit.DECODER_LOSS:
        values["fit_updates"] = max(1, iteration // 50)
    credit = MULTI_AGENT_CREDIT if algorithm.multi_agent else CreditSettings()
    credit_changes = settings.credit.model_dump(exclude_unset=True) if settings.credit else {}
    values |= {
        "algorithm": name,
        # An algorithm that was registered after `Settings` was defined has no field.
        "hyperparameters": getattr(settings, name, algorithm.settings),
        "steps": steps,
        "evaluate_every": evaluate_every,
        "credit": credit.model_copy(update=defaults["credit"] | credit_changes),
    }
    return ResolvedSettings(**values)


def _normalise(resolved: ResolvedSettings, task: TaskSpec, env: EnvSpec) -> ResolvedSettings:
    """Give settings that make no difference one value, so that equal runs have equal settings."""
    changes = {}
    if resolved.scored_observation == task.scored_observation:
        changes["scored_observation"] = None
    unused = unused_names(resolved)
    if "first_fit" in unused:
        changes["first_fit"] = None
    if "scale_rewards" in unused:
        changes["scale_rewards"] = False
    score, method = resolved.credit.score, METHODS.find(resolved.method)
    if score == "auto":
        score = find_score_key(task) or score
    is_fixed = env.fixed_length and task.payment_rule.is_regular(env.max_steps)
    if score != "binary" and is_fixed:
        score = "auto"  # sum and mean have the same decoder
    credit = resolved.credit.model_copy(update={"score": score, "exact": method.choose_exact(resolved.credit.exact)})
    has_start_value = method.has_start_value(credit, fixed_length=is_fixed)
    changes["credit"] = credit.model_copy(update={"start_value": has_start_value})
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
    min_steps = env.max_steps * resolved.environments // 2
    if resolved.steps < min_steps:
        raise LareError(
            f"steps = {resolved.steps} are too few: an episode of {task.name} takes up to {env.max_steps} steps, and a run with "
            f"environments = {resolved.environments} needs at least {min_steps}"
        )
    min_capacity = required_capacity(resolved.rollout_steps, env.max_steps) * resolved.environments
    if reads_old_steps(resolved) and resolved.capacity < min_capacity:
        data = "a rollout" if ALGORITHMS[resolved.algorithm].consumes is Consumes.ROLLOUTS else "an iteration"
        raise LareError(
            f"capacity = {resolved.capacity} is too small: {data} of {task.name} takes up to {min_capacity}"
        )
    if isinstance(resolved.hyperparameters, SequenceSettings):
        batch_size, rows = resolved.hyperparameters.batch_size, env.max_steps + 1
        # Each environment's running episode needs rows too.
        n_held = max(0, (resolved.capacity // resolved.environments + 1) // rows - 1) * resolved.environments
        if n_held < batch_size:
            enough = (round_up(batch_size, resolved.environments) + resolved.environments) * rows
            raise LareError(
                f"capacity = {resolved.capacity} holds {n_held} of the longest episodes of {task.name}, and an update reads {batch_size}: "
                f"use a capacity of {enough} or more, or a smaller {resolved.algorithm}.batch_size"
            )
