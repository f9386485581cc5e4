"""Algorithms that consume transitions: sample, fit the decoder if it is fitted here, relabel by it, update; many times in one
compiled call.

Algorithm 1 of the LaRe paper, lines 6 to 8, for TD3, DDPG and SAC. They train a single agent.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, Scalar

from lare_rl.algorithms.batches import Metrics, Transitions
from lare_rl.algorithms.off_policy import OffPolicySettings
from lare_rl.config.train_config import TrainConfig
from lare_rl.data import replay
from lare_rl.data.replay import StoredSteps
from lare_rl.data.sampling import sample_transitions
from lare_rl.data.trajectory import Trajectory
from lare_rl.training.decoder_fits import sample_credit, update_decoders
from lare_rl.training.episodes import Decoders
from lare_rl.training.learner import Learner
from lare_rl.training.rewards import rewards

__all__ = ["train_step"]


def train_step(
    learner: Learner, steps: Trajectory, key: PRNGKeyArray, env_steps: Int[Scalar, ""], config: TrainConfig
) -> tuple[Learner, Metrics]:
    """Update the algorithm once for each new step of all environments, and with it a decoder of `config.joint_fit`.

    `steps` are not read, because they are stored.
    """
    sample_key, _, update_key = jax.random.split(
        key, 3
    )  # the second key is unused: without it, all random numbers would change
    algorithm, settings, buffer = config.algorithm.load(), config.hyperparameters, learner.replay
    assert isinstance(settings, OffPolicySettings)

    def update(carry: tuple[Any, Decoders], inputs: Any) -> tuple[Any, Metrics]:
        state, decoders = carry
        update_index, index, credit_sample, key = inputs
        fit_key, key = jax.random.split(key)
        metrics = {}
        if credit_sample is not None:
            decoders, metrics = update_decoders(decoders, buffer, credit_sample, fit_key, config)
        stored = replay.read(buffer, index)
        batch = _transitions(stored, rewards(stored, decoders, config))
        state, algorithm_metrics = algorithm.update(state, batch, key, update_index, settings)
        return (state, decoders), metrics | algorithm_metrics

    # The steps of all updates are sampled at once. Their rows are read when the update runs.
    batch_key, credit_key = jax.random.split(sample_key)
    inputs = (
        env_steps - config.warmup + jnp.arange(config.iteration_steps),
        sample_transitions(buffer, batch_key, (config.iteration_steps, settings.batch_size)),
        sample_credit(buffer, credit_key, config.iteration_steps, config) if config.joint_fit else None,
        jax.random.split(update_key, config.iteration_steps),
    )
    (state, decoders), metrics = jax.lax.scan(update, (learner.algorithm, learner.decoders), inputs)
    return learner._replace(algorithm=state, decoders=decoders), jax.tree.map(jnp.mean, metrics)


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
