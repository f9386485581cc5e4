"""Credit as pure functions, for training loops that are compiled as a whole, such as PureJaxRL's.

    credit = lare_rl.pure_credit("lare-bayes", phi, observation_size=4, action_size=2, n_envs=8, n_steps=128, max_steps=500)
    state = credit.init(key)
    ...
    steps = lare_rl.CreditSteps(obs, action, next_obs, reward, terminated, truncated)      # [n_steps n_envs ...], inside jit and scan
    state = credit.refit(credit.observe(state, steps), key)
    r_hat = credit.reward(state, steps)                                             # [n_steps n_envs]

All shapes are fixed. The functions can be jitted, and mapped by `vmap`, `scan` and `shard_map`. The state is a pytree of arrays.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from lare_rl.algorithms.registry import ALGORITHMS
from lare_rl.credit.decoder_settings import CreditSettings, default_credit
from lare_rl.credit.methods import Reward, find_method
from lare_rl.data.replay import StoredSteps, by_payment, required_capacity
from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.interface import EnvSpec, Team, Timestep, to_env_action
from lare_rl.errors import LareError
from lare_rl.latent.function import LatentFunction
from lare_rl.tasks.spec import ScoredObservation
from lare_rl.training import episodes
from lare_rl.training.decoder_fits import fit_repeatedly
from lare_rl.training.factors import compute_factors
from lare_rl.training.learner import Learner, init_learner, replay_columns, store
from lare_rl.training.rewards import RewardState, rewards
from lare_rl.training.static_config import TrainConfig

__all__ = ["CreditSteps", "PureCredit", "pure_credit"]

State = Learner
"""The state of credit assignment: stored steps, and the decoder."""


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


class PureCredit(NamedTuple):
    """The functions."""

    init: Callable[[PRNGKeyArray], State]
    """Return the state before the first step."""
    observe: Callable[[State, CreditSteps], State]
    """Store the next `n_steps` steps of each environment."""
    refit: Callable[[State, PRNGKeyArray], State]
    """Fit the decoder to the episodes that have finished. A fit in closed form is only made when there are enough new ones."""
    reward: Callable[[State, CreditSteps], Float[Array, "time envs *agents"]]
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
        max_steps: the length of the longest episode. The decoder does not learn from longer ones.
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
    chosen, functions = find_method(method), () if phi is None else (phi,)
    if phi is not None and tuple(phi.sizes) != (observation_size, action_size):
        raise LareError(
            f"phi reads observations and actions of the sizes {phi.sizes[0]} and {phi.sizes[1]}, not {observation_size} and "
            f"{action_size}"
        )
    needs_episode = chosen.needs_whole_episodes or (chosen.inputs is not None and "history" in chosen.inputs.names)
    if chosen.reward not in (Reward.PROXY, Reward.DESIGNED) or needs_episode:
        raise LareError(f"{method} does not compute the reward of a step from this step alone: use bayes or lare-bayes")
    if settings is not None and settings.exact not in ("auto", "no"):
        raise LareError("pure_credit computes the reward of a step from this step alone: leave out the setting exact")
    if chosen.needs_phi and phi is None:
        raise LareError(f"{method} needs a latent function: phi=...")
    shape = (agents, action_size)
    env = EnvSpec(
        teams=(Team("agent", 0, agents),),
        observation_size=observation_size,
        action_size=action_size,
        discrete=discrete,
        max_steps=max_steps,
        low=np.broadcast_to(np.asarray(low, np.float32), shape),
        high=np.broadcast_to(np.asarray(high, np.float32), shape),
        is_jax=True,
    )
    algorithm = ALGORITHMS["ppo" if agents == 1 else "ippo"]  # on-policy, so that only what the decoder reads is stored
    config = TrainConfig(
        env=env,
        credit_scope="observation",
        scored_observation=scored_observation,
        method=chosen,
        algorithm=algorithm,
        hyperparameters=algorithm.settings,
        credit=settings or default_credit(agents),
        scale_rewards=scale_rewards,
        n_factors=tuple(function.n_factors(scored_observation) for function in functions),
        n_envs=n_envs,
        rollout_steps=n_steps,
        capacity=max(capacity // n_envs, required_capacity(n_steps, max_steps)),
        steps=0,
        fit_updates=fit_updates,
    )
    graphs = tuple(function.graph for function in functions)
    learn_returns = _make_learn_returns(config)

    def init(key: PRNGKeyArray) -> State:
        return init_learner(key, config, lambda _: ())

    def observe(state: State, steps: CreditSteps) -> State:
        if jnp.shape(steps.terminated) != (n_steps, n_envs):
            raise LareError(
                f"observe needs {n_steps} steps of {n_envs} environments, not {jnp.shape(steps.terminated)}"
            )
        return store(state, _trajectory(steps, config), config, graphs)[0]

    def refit(state: State, key: PRNGKeyArray) -> State:
        return _refit(state, key, learn_returns, config)

    def reward(state: State, steps: CreditSteps) -> Float[Array, "time envs *agents"]:
        trajectory = _trajectory(steps, config)
        stored = _stored_steps(state, trajectory, compute_factors(graphs, trajectory, config), config)
        r_hat = rewards(stored, RewardState(state.decoders, state.scale), config)
        return r_hat if agents > 1 else r_hat[..., 0]

    return PureCredit(init, observe, refit, reward)


def _trajectory(steps: CreditSteps, config: TrainConfig) -> Trajectory:
    """Return the steps with an axis of agents."""
    env, ended = config.env, jnp.asarray(steps.terminated)
    lead = ended.shape

    def with_agents(values: Array, *rest: int) -> Float[Array, "time envs agents *rest"]:
        return jnp.asarray(values, jnp.float32).reshape(*lead, env.n_agents, *rest)

    action = with_agents(steps.action, env.action_size)

    def timestep(observation: Array, reward: Array, terminated: Array, truncated: Array) -> Timestep:
        return Timestep(
            observation=with_agents(observation, env.observation_size),
            state=jnp.zeros((*lead, 0)),
            available=jnp.ones((*lead, env.n_agents, env.action_size), bool),
            alive=jnp.ones((*lead, env.n_agents), bool),
            reward=with_agents(reward),
            terminated=jnp.asarray(terminated, bool),
            truncated=jnp.asarray(truncated, bool),
            measures={},
        )

    nothing = jnp.zeros(lead, bool)
    return Trajectory(
        timestep=timestep(steps.observation, jnp.zeros((*lead, env.n_agents)), nothing, nothing),
        action=action,
        env_action=action if env.discrete else to_env_action(action, env),
        next_timestep=timestep(steps.next_observation, steps.reward, steps.terminated, steps.truncated),
    )


def _stored_steps(state: State, steps: Trajectory, factors: Array, config: TrainConfig) -> StoredSteps:
    """Return steps in the form of the replay's. Their episodes are as long as the finished ones on average."""
    columns, next_columns = replay_columns(steps, factors, config)
    lead, buffer = steps.next_timestep.terminated.shape, by_payment(state.replay)
    length = jnp.sum(buffer.transitions) // jnp.maximum(jnp.sum(buffer.episodes), 1)
    zeros = jnp.zeros((*lead, 1))
    return StoredSteps(
        columns=columns,
        next_columns=next_columns,
        episodic_reward=zeros,
        mean_reward=zeros,
        finished=jnp.zeros(lead, bool),
        last=jnp.zeros(lead, bool),
        residual=None,
        level=None,
        length=jnp.broadcast_to(length, lead),
    )


def _make_learn_returns(config: TrainConfig) -> Callable[..., Any]:
    """Return `learn_returns` as a function that `vmap` can map at any time.

    `learn_returns` must be traced with float64 enabled, but a user's `vmap` may trace it later, when it is not. So a mapped axis is
    merged into the axis of seeds.
    """

    @jax.custom_batching.custom_vmap
    def learn_returns(*inputs: Any) -> tuple[Any, ...]:
        with jax.enable_x64(True):
            decoders, buffer, n_learned = inputs
            return episodes.learn_returns(decoders, buffer, n_learned, config)

    @learn_returns.def_vmap
    def _map_learn_returns(axis_size: int, is_mapped: Any, *inputs: Any) -> tuple[Any, Any]:
        def merge(leaf: Array, mapped: bool) -> Array:
            leaf = leaf if mapped else jnp.broadcast_to(leaf, (axis_size, *leaf.shape))
            return leaf.reshape(leaf.shape[0] * leaf.shape[1], *leaf.shape[2:])  # -1 fails for an array without entries

        learned = learn_returns(*jax.tree.map(merge, list(inputs), is_mapped))
        learned = jax.tree.map(lambda leaf: leaf.reshape(axis_size, len(leaf) // axis_size, *leaf.shape[1:]), learned)
        return learned, jax.tree.map(lambda _: True, learned)

    return learn_returns


def _refit(state: State, key: PRNGKeyArray, learn_returns: Callable[..., Any], config: TrainConfig) -> State:
    if not state.decoders:
        return state
    inputs = jax.tree.map(lambda leaf: leaf[None], (state.decoders, state.replay, state.n_learned))
    decoders, n_learned, _ = jax.tree.map(lambda leaf: leaf[0], learn_returns(*inputs))
    state = state._replace(decoders=decoders, n_learned=n_learned)
    if not config.method.uses_gradient:
        return state
    has_episode = jnp.any(by_payment(state.replay).episodes > 0)
    fitted = jax.lax.cond(has_episode, lambda: fit_repeatedly(state, key, config)[0], lambda: state.decoders)
    return state._replace(decoders=fitted)
