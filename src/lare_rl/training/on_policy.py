"""Algorithms that consume rollouts: relabel the newest steps by the current decoder, and update the policy on them.

Algorithm 1 of the LaRe paper, lines 6 to 8, for PPO and IPPO. The decoder has been fitted before, to stored episodes.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Scalar, Shaped

from lare_rl.algorithms.batches import Metrics, Rollout
from lare_rl.config.train_config import TrainConfig
from lare_rl.data import replay
from lare_rl.data.trajectory import Trajectory
from lare_rl.training.episodes import store_predicted_returns
from lare_rl.training.learner import Learner
from lare_rl.training.policy import policy_input
from lare_rl.training.rewards import rewards

__all__ = ["train_step"]


def train_step(
    learner: Learner, steps: Trajectory, key: PRNGKeyArray, env_steps: Int[Scalar, ""], config: TrainConfig
) -> tuple[Learner, Metrics]:
    """Update the policy on `steps`, which have just been stored. Before them, each seed had made `env_steps` environment steps."""
    remaining = 1 - env_steps / config.steps
    rollout = _rollout(learner, steps, config)
    state, metrics = config.algorithm.load().update(learner.algorithm, rollout, key, remaining, config.hyperparameters)
    return learner._replace(algorithm=state), metrics


def _predict_newest_returns(learner: Learner, config: TrainConfig) -> Learner:
    """Predict the returns of all episodes that end in the newest steps."""
    buffer = replay.segments_as_episodes(learner.replay)
    since = replay.look_up(buffer.episode, jnp.arange(config.n_envs), buffer.next_transition - config.rollout_steps)
    return store_predicted_returns(learner, since, config)


def _rollout(learner: Learner, steps: Trajectory, config: TrainConfig) -> Rollout:
    """Return the newest steps with the method's rewards. Each agent of each environment is one actor of the rollout."""
    learner = _predict_newest_returns(learner, config) if config.is_exact else learner
    stored = replay.read_newest(learner.replay, config.rollout_steps)
    reward = rewards(stored, learner.decoders, config)  # [envs time agents]
    n_agents, agents_leave = config.env.n_agents, config.env.agents_leave

    def for_each_agent(values: Bool[Array, "time envs"]) -> Float[Array, "time envs agents"]:
        return jnp.broadcast_to(values[..., None], (*values.shape, n_agents)).astype(jnp.float32)

    # With gamma = 1, a time limit counts as an end: the critic learns the return up to it.
    gamma = getattr(config.hyperparameters, "gamma", 1)
    terminated = for_each_agent(steps.next_timestep.terminated if gamma < 1 else steps.ended)
    done = for_each_agent(steps.ended)
    if agents_leave:
        has_left = ~steps.next_timestep.alive
        terminated, done = jnp.maximum(terminated, has_left), jnp.maximum(done, has_left)

    def merge_actors(rows: Shaped[Array, "time envs agents *rest"]) -> Shaped[Array, "time actors *rest"]:
        return rows.reshape(len(rows), -1, *rows.shape[3:])

    return Rollout(
        observation=merge_actors(policy_input(steps.timestep.observation, config)),
        action=merge_actors(steps.action),
        reward=merge_actors(jnp.swapaxes(reward, 0, 1)),
        next_observation=merge_actors(policy_input(steps.next_timestep.observation, config)),
        terminated=merge_actors(terminated),
        done=merge_actors(done),
        available=merge_actors(steps.timestep.available) if config.env.masks_actions else None,
        mask=merge_actors(steps.timestep.alive.astype(jnp.float32)) if agents_leave else None,
    )
