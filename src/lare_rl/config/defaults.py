"""The default settings of a run, by task, method and algorithm."""

from collections.abc import Callable
from typing import Any

from lare_rl.algorithms.table import ALGORITHMS, Name
from lare_rl.config.settings import ResolvedSettings, Settings
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import find_method
from lare_rl.envs.interface import EnvSpec

MANY_AGENTS = CreditSettings(
    hidden=(64, 64, 64, 64),
    learning_rate=5e-4,
    weight_decay=1e-5,
    drawn_steps=10,
    steps=6400,
    encoder=(256,),
    bottleneck=4,
    divergence=1e-3,
)
"""The default settings of decoders for many agents. The numbers are those of LaRe's published code, except VIB's divergence."""


Usual = Callable[[EnvSpec, int], dict[str, Any]]
"""From an environment and the requested number of its copies (0: no request) to default settings."""


def transitions(env: EnvSpec, copies: int) -> dict[str, Any]:
    """td3, ddpg, sac."""
    return {"environments": copies or 1, "rollout_steps": 50, "evaluate_every": 5000, "capacity": 1_000_000}


def ppo(env: EnvSpec, copies: int) -> dict[str, Any]:
    copies = copies or 1
    return {
        "environments": copies,
        "rollout_steps": max(1, 2000 // copies),
        "fit_updates": 500,
        "evaluate_iterations": 5,
        "capacity": 1_000_000,
    }


def ippo(env: EnvSpec, copies: int) -> dict[str, Any]:
    """In JAX, as published for particle tasks: 82 episodes of 25 steps between two updates."""
    copies = copies or (82 if env.in_jax else 1)
    return {
        "environments": copies,
        "rollout_steps": env.max_steps if env.fixed_length else max(1, (2050 if env.in_jax else 2000) // copies),
        "fit_every": 10,
        "fit_updates": 50,
        "first_fit": "held-out",
        "steps_iterations": 1000,
        "evaluate_iterations": 10,
        "evaluation_episodes": 50 if env.in_jax else 10,
        "capacity": 15_000 * (env.max_steps + 1),
        "credit": MANY_AGENTS,
    }


def sequences(env: EnvSpec, copies: int) -> dict[str, Any]:
    """qmix, vdn. The method is the paper's, because closed-form credit has not been measured with these algorithms."""
    return {
        "method": "lare-rd",
        "environments": copies or (8 if env.in_jax else 1),
        "rollout_steps": 50,
        "steps": 2_000_000,
        "evaluate_every": 10_000,
        "evaluation_episodes": 32 if env.in_jax else 10,
        "capacity": 5000 * (env.max_steps + 1),
        "credit": MANY_AGENTS.model_copy(update={"drawn_steps": 24, "steps": 3200}),
    }


USUAL: dict[Name, Usual] = {
    "td3": transitions,
    "ddpg": transitions,
    "sac": transitions,
    "ppo": ppo,
    "ippo": ippo,
    "qmix": sequences,
    "vdn": sequences,
}
"""The default settings of a run, by algorithm."""


def algorithm_of(asked: Name | None, env: EnvSpec) -> Name:
    """The algorithm that is asked for; without one, the default for an environment."""
    if asked is not None:
        return asked
    if env.agents == 1:
        return "ppo" if env.discrete else "td3"
    return "qmix" if env.state_size and env.masks_actions and len(env.teams) == 1 else "ippo"


def resolve(settings: Settings, env: EnvSpec) -> ResolvedSettings:
    """Fill in the settings that are None. Raises `LareError` if the steps are not a multiple of an iteration's."""
    algorithm = algorithm_of(settings.algorithm, env)
    given = {name: value for name, value in settings if value is not None and name not in (*ALGORITHMS, "credit")}
    values = {
        "method": "lare-bayes",
        "steps": 1_000_000,
        "fit_every": 1,
        "fit_updates": 1,
        "evaluation_episodes": 10,
        "credit": CreditSettings(),
        "judges": None,
        **USUAL[algorithm](env, settings.environments or 0),
    }
    iteration = (settings.rollout_steps or values["rollout_steps"]) * values["environments"]
    for name in ("steps", "evaluate"):
        key = "steps" if name == "steps" else "evaluate_every"
        iterations = values.pop(f"{name}_iterations", None) or max(1, round(values[key] / iteration))
        values[key] = iterations * iteration
    method = settings.method or values["method"]
    fit = find_method(method).fit
    if fit is not None and fit.apart:
        values["fit_updates"] = max(1, iteration // 50)
    credit = values["credit"].model_copy(update=settings.credit.model_dump(exclude_none=True))
    decided = {"method": method, "algorithm": algorithm, "hyperparameters": getattr(settings, algorithm)}
    return ResolvedSettings(**{**values, **given, **decided, "credit": credit})
