"""Algorithms that consume rollouts: relabel the newest steps by the current decoder, update the policy on them.

Algorithm 1 of the LaRe paper, lines 6 to 8, for PPO and IPPO. The decoder was fitted to all stored episodes before.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray, Scalar, Shaped

from lare_rl.algorithms import ppo
from lare_rl.algorithms.settings import PPOSettings
from lare_rl.data import replay
from lare_rl.data.trajectory import Trajectory
from lare_rl.training import learner as common
from lare_rl.training.learner import Learner, Paid
from lare_rl.training.static_config import TrainConfig


def settings_of(config: TrainConfig) -> PPOSettings:
    """The algorithm's hyperparameters."""
    assert isinstance(config.hyperparameters, PPOSettings)
    return config.hyperparameters


def init(key: PRNGKeyArray, config: TrainConfig) -> ppo.PPO:
    """The untrained algorithm."""
    env = config.env
    return ppo.init(key, policy_input_size(config), env.action_size, env.discrete, settings_of(config))


def policy_input_size(config: TrainConfig) -> int:
    """Size of the rows that actor and critic see."""
    return config.env.observation_size + (config.env.agents if len(config.env.teams) > 1 else 0)


def policy_input(
    observation: Float[Array, "*batch agents observation"], config: TrainConfig
) -> Float[Array, "*batch agents policy_input"]:
    """The input of actor and critic: the observation and, if there are several teams, the agent's one-hot number."""
    if len(config.env.teams) == 1:
        return observation
    agents = config.env.agents
    number = jnp.broadcast_to(jnp.eye(agents), (*observation.shape[:-1], agents))
    return jnp.concatenate([observation, number], axis=-1)


def actor(learner: Learner, done: int, config: TrainConfig) -> ppo.Actor:
    """The parts of the learner that are needed to act, for all seeds."""
    return ppo.actor_of(learner.algorithm)


def memory(config: TrainConfig) -> tuple[()]:
    """The memory of an actor: none."""
    return ()


def act(
    actor: ppo.Actor,
    memory: tuple[()],
    observation: Float[Array, "*batch agents observation"],
    available: Array,
    noise: Float[Array, "*batch agents action"] | None,
    config: TrainConfig,
) -> tuple[Float[Array, "*batch agents action"], tuple[()]]:
    """The likeliest action or, with noise, an action of the policy."""
    shown, choices = policy_input(observation, config), available if config.env.masks_actions else None
    if noise is None:
        return ppo.act(actor, shown, choices), memory
    return ppo.explore(actor, shown, choices, noise), memory


def rollout(learner: Learner, steps: Trajectory, config: TrainConfig) -> ppo.Rollout:
    """The newest steps with the method's rewards. A lane is an agent in an environment."""
    stored = replay.read(learner.replay, replay.newest(learner.replay, config.rollout_steps))
    reward = common.rewards(stored, Paid(learner.credit, learner.scale), config)  # [envs time agents]
    agents, leave = config.env.agents, config.env.agents_leave

    def each(values: Array) -> Float[Array, "time envs agents"]:
        return jnp.broadcast_to(values[..., None], (*values.shape, agents)).astype(jnp.float32)

    # Without a discount, the value after a time limit is not finite. The episode's value is then its return up to the limit.
    over = steps.after.terminated if settings_of(config).gamma < 1 else steps.ended
    continues, ended = each(~jnp.asarray(over)), each(jnp.asarray(steps.ended))
    if leave:
        stays = jnp.asarray(steps.after.alive)
        continues, ended = continues * stays, jnp.maximum(ended, ~stays)

    def lanes(rows: Shaped[Array, "time envs agents *rest"]) -> Shaped[Array, "time lanes *rest"]:
        return rows.reshape(len(rows), -1, *rows.shape[3:])

    return ppo.Rollout(
        observation=lanes(policy_input(steps.before.observation, config)),
        action=lanes(steps.action),
        reward=lanes(jnp.swapaxes(reward, 0, 1)),
        next_observation=lanes(policy_input(steps.after.observation, config)),
        continues=lanes(continues),
        ended=lanes(ended),
        available=lanes(steps.before.available) if config.env.masks_actions else None,
        mask=lanes(jnp.asarray(steps.before.alive).astype(jnp.float32)) if leave else None,
    )


def improve_one(
    learner: Learner, steps: Trajectory, key: PRNGKeyArray, done: Int[Scalar, ""], config: TrainConfig
) -> tuple[Learner, dict[str, Float[Array, ""]]]:
    """Update the policy on the steps that have just been stored."""
    remaining = 1 - done / config.steps
    newest = rollout(learner, jax.tree.map(jnp.asarray, steps), config)
    algorithm, measured = ppo.update(learner.algorithm, newest, key, remaining, settings_of(config))
    return learner._replace(algorithm=algorithm), measured


def improve(
    learner: Learner, steps: Trajectory, keys: Key[Array, " seeds"], done: Int[Scalar, ""], config: TrainConfig
) -> tuple[Learner, dict[str, Float[Array, " seeds"]]]:
    """`improve_one` for all seeds."""
    return jax.vmap(partial(improve_one, config=config), in_axes=(0, 0, 0, None))(learner, steps, keys, done)
