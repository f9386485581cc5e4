"""The default settings of a run, by task, method and algorithm."""

from typing import Any

from lare_rl.algorithms.registry import ALGORITHMS
from lare_rl.config.settings import ResolvedSettings, Settings
from lare_rl.credit.decoder_settings import MULTI_AGENT_CREDIT, CreditSettings
from lare_rl.credit.methods import find_method
from lare_rl.envs.interface import EnvSpec

__all__ = ["apply_defaults", "choose_algorithm"]


def choose_algorithm(name: str | None, env: EnvSpec) -> str:
    """Return the requested algorithm, or the default one for an environment."""
    if name is not None:
        return name
    if env.n_agents == 1:
        return "ppo" if env.discrete else "td3"
    return "qmix" if env.state_size and env.masks_actions and len(env.teams) == 1 else "ippo"


def apply_defaults(settings: Settings, env: EnvSpec) -> ResolvedSettings:
    """Fill in the settings that are None.

    Raises:
        LareError: the steps are not a multiple of an iteration's.
    """
    algorithm = choose_algorithm(settings.algorithm, env)
    row = ALGORITHMS[algorithm]
    defaults: dict[str, Any] = {
        "method": "lare-bayes",
        "steps": 1_000_000,
        "fit_every": 1,
        "fit_updates": 1,
        "evaluation_episodes": 10,
        "credit": {},
        **row.run_defaults(env, settings.environments or 0),
    }
    iteration = (settings.rollout_steps or defaults["rollout_steps"]) * defaults["environments"]
    for name, iterations in (("steps", "steps_iterations"), ("evaluate_every", "evaluate_iterations")):
        n_iterations = defaults.pop(iterations, None) or max(1, round(defaults[name] / iteration))
        defaults[name] = n_iterations * iteration
    method = find_method(settings.method or defaults["method"])
    if method.fit is not None and method.fit.separate:
        defaults["fit_updates"] = max(1, iteration // 50)

    set_values = {name: value for name, value in settings if value is not None and name not in ALGORITHMS}
    credit = MULTI_AGENT_CREDIT if row.multi_agent else CreditSettings()
    set_credit = (
        {name: getattr(settings.credit, name) for name in settings.credit.model_fields_set} if settings.credit else {}
    )
    decided = {
        "algorithm": algorithm,
        "hyperparameters": getattr(settings, algorithm, row.settings),  # one that was registered late has no field
        "credit": credit.model_copy(update=defaults["credit"] | set_credit),
    }
    return ResolvedSettings(**{**defaults, **set_values, **decided})
