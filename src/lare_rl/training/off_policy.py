"""Algorithms that consume transitions: sample, fit the decoder, relabel by it, update; many times in one compiled call.

Algorithm 1 of the LaRe paper, lines 6 to 8, for TD3, DDPG and SAC. They train a single agent.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray, Scalar

from lare_rl.algorithms.batches import Transitions
from lare_rl.algorithms.off_policy import OffPolicySettings
from lare_rl.credit.engine import RewardSource, select_decoders
from lare_rl.data import replay
from lare_rl.data.replay import Index, Replay, StoredSteps
from lare_rl.data.sampling import CreditSample, sample_transitions
from lare_rl.data.trajectory import Trajectory
from lare_rl.training.decoder_fits import fit_decoders, sample_credit
from lare_rl.training.learner import Learner
from lare_rl.training.memoryless import get_actor, init_memory
from lare_rl.training.rewards import rewards
from lare_rl.training.static_config import TrainConfig

__all__ = ["act", "get_actor", "init", "init_memory", "train_step"]


class UpdateSample(NamedTuple):
    """The transitions that one update reads, by number. The rows are read when the update runs."""

    batch: Index
    credit: CreditSample | None


def _settings(config: TrainConfig) -> OffPolicySettings:
    assert isinstance(config.hyperparameters, OffPolicySettings)
    return config.hyperparameters


def init(key: PRNGKeyArray, config: TrainConfig) -> Any:
    """Return the untrained algorithm."""
    env = config.env
    return config.algorithm.load().init(key, env.observation_size, env.action_size, _settings(config))


def act(
    actor: Any,
    memory: tuple[()],
    observation: Float[Array, "*batch agents observation"],
    available: Array,
    noise: Float[Array, "*batch agents action"] | None,
    config: TrainConfig,
) -> tuple[Float[Array, "*batch agents action"], tuple[()]]:
    """Return the actions of the deterministic policy or, with standard normal noise, of the policy that collects."""
    algorithm = config.algorithm.load()
    if noise is None:
        return algorithm.act(actor, observation), memory
    return algorithm.explore(actor, observation, noise, _settings(config)), memory


def train_step(
    learner: Learner, steps: Trajectory, keys: Key[Array, " seeds"], env_steps: Int[Scalar, ""], config: TrainConfig
) -> tuple[Learner, dict[str, Float[Array, " seeds"]]]:
    """Update decoder and algorithm once for each new step of an environment. Of `steps`, only the number matters."""
    return jax.vmap(partial(_train_seed, config=config), in_axes=(0, 0, None))(learner, keys, env_steps)


def _train_seed(
    learner: Learner, key: PRNGKeyArray, env_steps: Int[Scalar, ""], config: TrainConfig
) -> tuple[Learner, dict[str, Float[Array, ""]]]:
    sample_key, _, noise_key = jax.random.split(key, 3)
    buffer, settings = learner.replay, _settings(config)
    algorithm = config.algorithm.load()
    n_updates = config.rollout_steps * config.n_envs

    def update(
        carry: tuple[Any, tuple[RewardSource, ...]], inputs: tuple[Int[Scalar, ""], UpdateSample, PRNGKeyArray]
    ) -> tuple[Any, dict[str, Array]]:
        state, sources = carry
        update_index, sample, key = inputs
        fit_key, key = jax.random.split(key)
        metrics = {}
        if sample.credit is not None:
            sources, metrics = fit_decoders(select_decoders(sources), buffer, sample.credit, fit_key, config)
        steps = replay.read(buffer, sample.batch)
        reward = rewards(steps, sources, config)
        batch = _transitions(steps, reward)
        state, algorithm_metrics = algorithm.update(state, batch, key, update_index, settings)
        return (state, sources), metrics | algorithm_metrics

    update_index = env_steps - settings.warmup + jnp.arange(n_updates)
    inputs = (update_index, _sample(buffer, sample_key, n_updates, config), jax.random.split(noise_key, n_updates))
    (state, sources), metrics = jax.lax.scan(update, (learner.algorithm, learner.reward_sources), inputs)
    return learner._replace(algorithm=state, reward_sources=sources), jax.tree.map(jnp.mean, metrics)


def _sample(buffer: Replay, key: PRNGKeyArray, n_updates: int, config: TrainConfig) -> UpdateSample:
    """Sample the steps of many updates at once."""
    batch_key, credit_key = jax.random.split(key)
    batch = sample_transitions(buffer, batch_key, (n_updates, _settings(config).batch_size))
    return UpdateSample(batch, sample_credit(buffer, credit_key, n_updates, config) if config.joint_fit else None)


def _transitions(steps: StoredSteps, reward: Float[Array, "batch 1"]) -> Transitions:
    """Return the steps of the only agent as the algorithm's batch."""
    columns, next_columns = steps.columns, steps.next_columns
    return Transitions(
        observation=columns["observation"][:, 0],
        action=columns["action"][:, 0],
        reward=reward[:, 0],
        next_observation=next_columns["observation"][:, 0],
        terminated=columns["terminated"].astype(jnp.float32),
    )
