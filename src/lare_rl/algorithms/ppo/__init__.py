"""PPO and IPPO: hyperparameters, default run settings and registration. The update is in `ppo.py`."""

from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from lare_rl.algorithms.registry import Algorithm, AlgorithmSettings, Consumes, register_algorithm
from lare_rl.errors import Count

if TYPE_CHECKING:
    from lare_rl.envs.interface import EnvSpec

__all__ = ["PPOSettings"]

MIN_ROLLOUT_STEPS = 16
"""The default rollout has at least this many steps of each environment, because advantages need some steps in a row."""
ROLLOUT_STEPS = 2000
"""The steps of all environments together in the default rollout."""


class PPOSettings(AlgorithmSettings):
    """Hyperparameters of PPO."""

    hidden: tuple[Count, ...] = (64, 64)
    """Widths of the hidden layers of actor and critic."""
    learning_rate: Annotated[float, Field(gt=0)] = 3e-4
    """Learning rate of Adam."""
    gamma: Annotated[float, Field(ge=0, le=1)] = 0.99
    """Discount factor."""
    gae_lambda: Annotated[float, Field(ge=0, le=1)] = 0.95
    """Lambda of the advantage estimates (GAE): 0 relies on the critic, 1 on the rewards."""
    epochs: Count = 10
    """Passes over the rollout in one update."""
    minibatch_size: Count = 64
    """Samples per gradient step: steps of single agents."""
    clip: Annotated[float, Field(gt=0)] = 0.2
    """How far the probability ratio may move from 1."""
    value_clip: Annotated[float, Field(gt=0)] = 0.5
    """How far the value may move in one update, in standard deviations of the return."""
    value_coef: Annotated[float, Field(ge=0)] = 0.5
    """Coefficient of the value loss."""
    entropy_coef: Annotated[float, Field(ge=0)] = 0.01
    """Coefficient of the entropy bonus."""
    huber_delta: Annotated[float, Field(gt=0)] = 10.0
    """Error at which the value loss becomes linear, in standard deviations of the return."""
    max_grad_norm: Annotated[float, Field(gt=0)] = 0.5
    """Largest norm of the joint gradient of actor and critic."""
    anneal: bool = True
    """Let learning rate and clip fall linearly to 0 over the run."""
    normalise_observations: bool = False
    """Normalise observations by their running mean and standard deviation."""


def _ppo_defaults(env: "EnvSpec", environments: int | None) -> dict[str, Any]:
    environments = environments or 1
    n_steps = max(MIN_ROLLOUT_STEPS, ROLLOUT_STEPS // environments)
    return {
        "environments": environments,
        # Rounded to episodes of maximum length, unless that would give 0.
        "rollout_steps": round(n_steps / env.max_steps) * env.max_steps or n_steps,
        "fit_updates": 500,
        "evaluate_iterations": 5,
    }


def _ippo_defaults(env: "EnvSpec", environments: int | None) -> dict[str, Any]:
    # In JAX, as published for particle tasks: 82 episodes of 25 steps between two updates.
    environments = environments or (82 if env.is_jax else 1)
    all_steps = 2050 if env.is_jax else ROLLOUT_STEPS
    return {
        "environments": environments,
        "rollout_steps": env.max_steps if env.fixed_length else max(MIN_ROLLOUT_STEPS, all_steps // environments),
        "fit_every": 10,
        "fit_updates": 50,
        "first_fit": "held-out",
        "steps": 1000 * all_steps,
        "evaluate_every": 10 * all_steps,
        "evaluation_episodes": 50 if env.is_jax else 10,
        "capacity": 15_000 * (env.max_steps + 1),
    }


register_algorithm(
    Algorithm(
        name="ppo",
        consumes=Consumes.ROLLOUTS,
        settings=PPOSettings(hidden=(256, 256), normalise_observations=True),
        module="lare_rl.algorithms.ppo.ppo",
        run_defaults=_ppo_defaults,
        summary="clipped policy steps on the newest rollout; observations are normalised",
        source="Schulman et al., 2017; a Gaussian takes the place of LaRe's Beta policy",
    )
)
register_algorithm(
    Algorithm(
        name="ippo",
        consumes=Consumes.ROLLOUTS,
        settings=PPOSettings(learning_rate=1e-4, gamma=1.0, minibatch_size=128, clip=0.5, max_grad_norm=10.0),
        module="lare_rl.algorithms.ppo.ppo",
        run_defaults=_ippo_defaults,
        summary="PPO for every agent, with shared parameters",
        source="de Witt et al., 2020; hyperparameters of LaRe",
        single_agent=False,
        multi_agent=True,
        multi_team=True,
    )
)
