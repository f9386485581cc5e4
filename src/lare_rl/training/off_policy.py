"""Algorithms that consume transitions: sample, fit the decoder, relabel by it, update; many times in one compiled call.

Algorithm 1 of the LaRe paper, lines 6 to 8, for TD3, DDPG and SAC. Each is a module with the same functions: `init`, `act`,
`explore` and `update`. They train a single agent.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray, Scalar

from lare_rl.algorithms import sac, td3
from lare_rl.algorithms.critics import Transitions
from lare_rl.algorithms.settings import OffPolicySettings, SACSettings
from lare_rl.credit.decomposition import Decomposition
from lare_rl.data import replay
from lare_rl.data.replay import Index, Replay, StoredSteps
from lare_rl.data.sampling import CreditSample, sample_transitions
from lare_rl.data.trajectory import Trajectory
from lare_rl.nn.networks import MLP
from lare_rl.training import learner as common
from lare_rl.training.learner import Learner, Paid, sample_credit
from lare_rl.training.static_config import TrainConfig


class UpdateSample(NamedTuple):
    """The transitions that one update reads, by number. The rows are read when the update runs."""

    batch: Index
    credit: CreditSample | None


def settings_of(config: TrainConfig) -> OffPolicySettings:
    """The algorithm's hyperparameters."""
    assert isinstance(config.hyperparameters, OffPolicySettings)
    return config.hyperparameters


def module_of(config: TrainConfig) -> Any:
    """The algorithm's module."""
    return sac if isinstance(config.hyperparameters, SACSettings) else td3


def init(key: PRNGKeyArray, config: TrainConfig) -> Any:
    """The untrained algorithm."""
    return module_of(config).init(key, config.env.observation_size, config.env.action_size, settings_of(config))


def actor(learner: Learner, done: int, config: TrainConfig) -> MLP:
    """The parts of the learner that are needed to act, for all seeds."""
    return learner.algorithm.online.actor


def memory(config: TrainConfig) -> tuple[()]:
    """The memory of an actor: none."""
    return ()


def act(
    actor: MLP,
    memory: tuple[()],
    observation: Float[Array, "*batch agents observation"],
    available: Array,
    noise: Float[Array, "*batch agents action"] | None,
    config: TrainConfig,
) -> tuple[Float[Array, "*batch agents action"], tuple[()]]:
    """The deterministic policy, or, with standard normal noise, the policy that collects."""
    module = module_of(config)
    if noise is None:
        return module.act(actor, observation), memory
    return module.explore(actor, observation, noise, settings_of(config)), memory


def sample(buffer: Replay, key: PRNGKeyArray, updates: int, config: TrainConfig) -> UpdateSample:
    """Choose the steps of many updates at once."""
    batch_key, credit_key = jax.random.split(key)
    batch = sample_transitions(buffer, batch_key, (updates, settings_of(config).batch_size))
    return UpdateSample(batch, sample_credit(buffer, credit_key, updates, config) if config.interleaved else None)


def improve_one(
    learner: Learner, steps: Trajectory, key: PRNGKeyArray, done: Int[Scalar, ""], config: TrainConfig
) -> tuple[Learner, dict[str, Float[Array, ""]]]:
    """One update for each new step of an environment; the mean of each metric over them."""
    sample_key, _, noise_key = jax.random.split(key, 3)
    buffer, settings = learner.replay, settings_of(config)
    updates = config.rollout_steps * config.environments

    def one(
        carry: tuple[Any, tuple[Decomposition, ...]], update: tuple[Int[Scalar, ""], UpdateSample, PRNGKeyArray]
    ) -> tuple[Any, dict[str, Array]]:
        algorithm, credit = carry
        number, chosen, key = update
        fit_key, key = jax.random.split(key)
        measured = {}
        if chosen.credit is not None:
            credit, measured = common.fit(credit, buffer, chosen.credit, fit_key, config)
        steps = replay.read(buffer, chosen.batch)
        reward = common.rewards(steps, Paid(credit, learner.scale), config)
        algorithm, learned = module_of(config).update(algorithm, transitions(steps, reward), key, number, settings)
        return (algorithm, credit), measured | learned

    numbers = done - settings.warmup + jnp.arange(updates)
    each = (numbers, sample(buffer, sample_key, updates, config), jax.random.split(noise_key, updates))
    (algorithm, credit), measured = jax.lax.scan(one, (learner.algorithm, learner.credit), each)
    return learner._replace(algorithm=algorithm, credit=credit), jax.tree.map(jnp.mean, measured)


def transitions(steps: StoredSteps, reward: Float[Array, "batch 1"]) -> Transitions:
    """Steps of the only agent, as the algorithm sees them."""
    before, after = steps.before, steps.after
    continues = 1.0 - before["terminated"]
    return Transitions(
        before["observation"][:, 0], before["action"][:, 0], reward[:, 0], after["observation"][:, 0], continues
    )


def improve(
    learner: Learner, steps: Trajectory, keys: Key[Array, " seeds"], done: Int[Scalar, ""], config: TrainConfig
) -> tuple[Learner, dict[str, Float[Array, " seeds"]]]:
    """`improve_one` for all seeds."""
    return jax.vmap(partial(improve_one, config=config), in_axes=(0, 0, 0, None))(learner, steps, keys, done)
