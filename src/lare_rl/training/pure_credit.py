"""Credit as pure functions, for training loops that are compiled as a whole, such as PureJaxRL's.

    credit = lare_rl.pure_credit("lare-bayes", phi, observation_size=4, action_size=2, n_envs=8, n_steps=128, max_steps=500)
    state = credit.init(key)
    ...
    steps = lare_rl.CreditSteps(obs, action, next_obs, reward, terminated, truncated)      # [n_steps n_envs ...], inside jit and scan
    state = credit.refit(credit.observe(state, steps), key)
    r_hat = credit.reward(state, steps)                                             # [n_steps n_envs]

All shapes are fixed. The functions can be jitted, and mapped by `vmap`, `scan` and `shard_map`. The state is a pytree of arrays.
`state.n_invalid` should stay 0: it counts the steps for which `phi` gave a number that is not finite.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lare_rl.algorithms.registry import Consumes
from lare_rl.config.train_config import CreditConfig
from lare_rl.config.validity import check_phi, check_training
from lare_rl.credit.decoder_settings import CreditSettings, resolve_credit
from lare_rl.credit.methods import METHODS, Reward
from lare_rl.data.replay import StoredSteps, mean_length, required_capacity, segments_as_episodes
from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.interface import EnvSpec, Team, to_env_action
from lare_rl.envs.vec_env import empty_batch
from lare_rl.errors import LareError, check_count, short_repr
from lare_rl.latent.function import LatentFunction
from lare_rl.phi.graph import Graph
from lare_rl.tasks.spec import ScoredObservation
from lare_rl.training import episodes
from lare_rl.training.decoder_fits import update_repeatedly
from lare_rl.training.decoder_inputs import compute_factors
from lare_rl.training.learner import Learner, init_learner, replay_columns, store_with_factors
from lare_rl.training.rewards import rewards
from lare_rl.util.float64 import float64, require_float32

__all__ = ["CreditSteps", "PureCredit", "PureCreditState", "pure_credit"]


class CreditSteps(NamedTuple):
    """Consecutive steps of several environments. With several agents, the arrays marked `*agents` have an axis of agents."""

    observation: Float[Array, "time envs *agents observation"]
    action: Float[Array, "time envs *agents action"]
    """Continuous actions in [-1, 1]; discrete actions one-hot."""
    next_observation: Float[Array, "time envs *agents observation"]
    """After the step: the observation of the next step or, at the end of an episode, its last one, not the first of the next."""
    reward: Float[Array, "time envs *agents"]
    """What the environment pays. Only its sum over an episode matters."""
    terminated: Bool[Array, "time envs"]
    truncated: Bool[Array, "time envs"]


class PureCreditState(NamedTuple):
    """The state of credit assignment."""

    learner: Learner
    """The stored steps, and the decoder. It trains no algorithm."""
    n_invalid: Int[Array, ""]
    """For how many steps of an agent `phi` has given a factor that is not finite. The decoder does not read them, and their proxy
    rewards are 0."""


class PureCredit(NamedTuple):
    """The functions that `pure_credit` returns."""

    init: Callable[[PRNGKeyArray], PureCreditState]
    """Return the state before the first step."""
    observe: Callable[[PureCreditState, CreditSteps], PureCreditState]
    """Store the next `n_steps` steps of each environment."""
    refit: Callable[[PureCreditState, PRNGKeyArray], PureCreditState]
    """Fit the decoder to the episodes that have finished. A fit in closed form is only made when there are enough new ones."""
    reward: Callable[[PureCreditState, CreditSteps], Float[Array, "time envs *agents"]]
    """Return the proxy rewards of any steps, by the decoder's newest fit. Before the first fit, they are nearly 0."""


def pure_credit(
    method: str = "lare-bayes",
    phi: LatentFunction | None = None,
    *,
    observation_size: int,
    action_size: int,
    n_envs: int,
    n_steps: int,
    max_steps: int,
    discrete: bool = False,
    agents: int = 1,
    low: Any = -1.0,
    high: Any = 1.0,
    scored_observation: ScoredObservation = "after",
    capacity: int = 1_000_000,
    fit_updates: int = 500,
    settings: CreditSettings | None = None,
    scale_rewards: bool = False,
) -> PureCredit:
    """Return credit assignment as pure functions.

    Args:
        method: the name of a method that gives each step a reward of its own (`lare-rl methods`).
        phi: the latent function, for the methods that need one.
        observation_size: the length of an agent's observation.
        action_size: the length of a continuous action, or the number of discrete actions.
        n_envs: the number of environments.
        n_steps: the steps of each environment that `observe` stores at a time.
        max_steps: the number of steps of the longest episode. From a longer one, nothing or something wrong is learned.
        discrete: whether actions are discrete.
        agents: the number of agents of a team, which shares its return.
        low: the lower bounds of continuous actions in the environment's units, which `phi` reads.
        high: the upper bounds.
        scored_observation: the observations of a step that factors and raw features are computed from: "before", "after" or "both".
        capacity: the number of steps that are stored.
        fit_updates: gradient updates of the decoder in each `refit`. Ignored for a closed form.
        settings: the settings of the decoder.
        scale_rewards: divide r_hat by the running root mean square of R/T.

    Raises:
        LareError: the arguments do not go together.
    """
    require_float32()
    counts = {"observation_size": observation_size, "action_size": action_size, "n_envs": n_envs, "n_steps": n_steps}
    counts |= {"max_steps": max_steps, "agents": agents, "capacity": capacity, "fit_updates": fit_updates}
    for name, value in counts.items():
        check_count(name, value)
    if scored_observation not in get_args(ScoredObservation):
        raise LareError(f"scored_observation = {short_repr(scored_observation)}: give 'before', 'after' or 'both'")
    if not isinstance(settings, CreditSettings | None):
        raise LareError(f"settings must be a lare_rl.CreditSettings, and are {short_repr(settings)}")
    chosen, credit = METHODS.find(method), resolve_credit(settings, agents)
    if not isinstance(phi, LatentFunction | None):
        raise LareError(f"phi must come from lare_rl.design or lare_rl.load_function, and is {short_repr(phi)}")
    if phi is not None and tuple(phi.sizes) != (observation_size, action_size):
        raise LareError(
            f"phi reads observations and actions of the sizes {phi.sizes[0]} and {phi.sizes[1]}, not {observation_size} and {action_size}"
        )
    check_phi(chosen, phi, scored_observation)
    env = EnvSpec(
        teams=(Team("agent", 0, agents),),
        observation_size=observation_size,
        action_size=action_size,
        discrete=discrete,
        max_steps=max_steps,
        low=_read_bounds("low", low, (agents, action_size)),
        high=_read_bounds("high", high, (agents, action_size)),
        is_jax=True,
    )
    config = CreditConfig(
        env=env,
        scored_observation=scored_observation,
        method=chosen,
        credit=credit,
        scale_rewards=scale_rewards,
        n_factors=() if phi is None else (phi.n_factors(scored_observation),),
        n_envs=n_envs,
        rollout_steps=n_steps,
        capacity=max(capacity // n_envs, required_capacity(n_steps, max_steps)),
        fit_updates=fit_updates,
        consumes=Consumes.ROLLOUTS,
        masks_steps=phi is not None,  # those whose factors are invalid
    )
    _check_steps(config)
    check_training(config)
    return _make_functions(config, () if phi is None else (phi.graph,))


def _read_bounds(name: str, bounds: Any, shape: tuple[int, int]) -> Float[np.ndarray, "agents action"]:
    try:
        return np.broadcast_to(np.asarray(bounds, np.float32), shape)
    except (TypeError, ValueError):
        raise LareError(
            f"{name} = {short_repr(bounds)}: give a number, or numbers of the shape {shape[1:]} or {shape}"
        ) from None


def _check_steps(config: CreditConfig) -> None:
    """Raise `LareError` if the reward of a step is not computed from this step alone."""
    method, name = config.method, config.method.name
    reads_history = method.decoder_kind.whole_episodes or "history" in config.credit_specs[0].inputs
    if method.reward not in (Reward.PROXY, Reward.DESIGNED) or reads_history:
        raise LareError(f"{name} does not compute the reward of a step from this step alone: use bayes or lare-bayes")
    if config.credit.exact not in ("auto", "no"):
        raise LareError("exact needs the other steps of an episode: leave it out")


def _make_functions(config: CreditConfig, phi: tuple[Graph, ...]) -> PureCredit:
    learn_returns = _make_learn_returns(config)
    batch_shape = (config.rollout_steps, config.n_envs)

    def init(key: PRNGKeyArray) -> PureCreditState:
        return PureCreditState(init_learner(key, config, lambda _: ()), jnp.zeros((), jnp.int32))

    def observe(state: PureCreditState, steps: CreditSteps) -> PureCreditState:
        if jnp.shape(steps.terminated) != batch_shape:
            raise LareError(
                f"observe needs {batch_shape[0]} steps of {batch_shape[1]} environments, not {jnp.shape(steps.terminated)}"
            )
        trajectory = _trajectory(steps, config)
        factors, is_valid = _valid_factors(phi, trajectory, config)
        learner = store_with_factors(state.learner, trajectory, factors, config, is_valid)
        return PureCreditState(learner, state.n_invalid + jnp.sum(~is_valid))

    def refit(state: PureCreditState, key: PRNGKeyArray) -> PureCreditState:
        learner = state.learner
        if config.method.fit is None:
            return state
        seeds = jax.tree.map(lambda leaf: leaf[None], learner)
        decoders, n_learned = jax.tree.map(lambda leaf: leaf[0], learn_returns(seeds))
        learner = learner._replace(decoders=decoders, n_learned=n_learned)
        if config.method.uses_gradient:
            has_episode = jnp.any(segments_as_episodes(learner.replay).current_episode > 0)
            fitted = jax.lax.cond(has_episode, lambda: update_repeatedly(learner, key, config)[0], lambda: decoders)
            learner = learner._replace(decoders=fitted)
        return state._replace(learner=learner)

    def reward(state: PureCreditState, steps: CreditSteps) -> Float[Array, "time envs *agents"]:
        trajectory = _trajectory(steps, config)
        factors, is_valid = _valid_factors(phi, trajectory, config)
        columns = replay_columns(trajectory, factors, config, is_valid)
        r_hat = rewards(_stored_steps(state.learner, *columns), state.learner.decoders, config)
        return r_hat if config.env.n_agents > 1 else r_hat[..., 0]

    return PureCredit(init, observe, refit, reward)


def _valid_factors(
    phi: tuple[Graph, ...], steps: Trajectory, config: CreditConfig
) -> tuple[Float[Array, "time envs agents factors"], Bool[Array, "time envs agents"]]:
    """Return the factors of steps, and for which steps of an agent they are finite. Where they are not, all factors are 0."""
    factors = compute_factors(phi, steps, config)
    is_valid = jnp.all(jnp.isfinite(factors), axis=-1)
    return jnp.where(is_valid[..., None], factors, 0), is_valid


def _trajectory(steps: CreditSteps, config: CreditConfig) -> Trajectory:
    """Return the steps with an axis of agents."""
    env, lead = config.env, jnp.shape(steps.terminated)

    def read(name: str, *rest: int) -> Float[Array, "time envs agents *rest"]:
        values, shape = jnp.asarray(getattr(steps, name), jnp.float32), (*lead, env.n_agents, *rest)
        if values.shape[: len(lead)] != lead or values.size != math.prod(shape):
            raise LareError(f"{name} has the shape {values.shape}, and should have {shape}")
        return values.reshape(shape)

    action = read("action", env.action_size)
    empty = jax.tree.map(jnp.asarray, empty_batch(env, *lead))
    timestep = empty._replace(observation=read("observation", env.observation_size), alive=jnp.ones_like(empty.alive))
    next_timestep = timestep._replace(
        observation=read("next_observation", env.observation_size),
        reward=read("reward"),
        terminated=jnp.asarray(steps.terminated, bool),
        truncated=jnp.asarray(steps.truncated, bool),
    )
    env_action = action if env.discrete else to_env_action(action, env)
    return Trajectory(timestep, action, env_action, next_timestep)


def _stored_steps(learner: Learner, columns: dict[str, Any], next_columns: dict[str, Any]) -> StoredSteps:
    """Return steps as if the replay stored them, in episodes of the mean length of the finished ones."""
    lead = columns["reward"].shape[:2]
    zeros = jnp.zeros((*lead, 1))
    return StoredSteps(
        columns=columns,
        next_columns=next_columns,
        episodic_reward=zeros,
        mean_reward=zeros,
        episode_ended=jnp.zeros(lead, bool),
        last=jnp.zeros(lead, bool),
        residual=None,
        level=None,
        length=jnp.broadcast_to(mean_length(segments_as_episodes(learner.replay)), lead),
    )


def _make_learn_returns(config: CreditConfig) -> Callable[[Learner], tuple[Any, Any]]:
    """Return a function from learners to their decoders after `learn_returns`, and `n_learned`, that `vmap` can map at any time.

    `learn_returns` must be traced with float64 enabled, but a user's `vmap` may trace it later, when it is not. So a mapped axis is
    merged into the axis of seeds.
    """

    @jax.custom_batching.custom_vmap
    def learn_returns(learner: Learner) -> tuple[Any, Any]:
        with float64():
            learned = episodes.learn_returns(learner, config)
        return learned.decoders, learned.n_learned

    @learn_returns.def_vmap
    def _map_learn_returns(axis_size: int, is_mapped: Any, learner: Learner) -> tuple[Any, Any]:
        def merge(leaf: Array, mapped: bool) -> Array:
            leaf = leaf if mapped else jnp.broadcast_to(leaf, (axis_size, *leaf.shape))
            return leaf.reshape(leaf.shape[0] * leaf.shape[1], *leaf.shape[2:])  # -1 fails for an array without entries

        learned = learn_returns(jax.tree.map(merge, learner, *is_mapped))
        learned = jax.tree.map(lambda leaf: leaf.reshape(axis_size, len(leaf) // axis_size, *leaf.shape[1:]), learned)
        return learned, jax.tree.map(lambda _: True, learned)

    return learn_returns
