"""How well decoders for many agents predict the rewards of single steps after a number of updates, on fixed data.

    python benchmarks/decoder_updates.py

1,600 episodes of random actions on CN-6, one seed, updates on 32 episodes each. On 200 other episodes, with rewards averaged over
the agents: the correlation of proxy and true rewards as deviations from their episode's mean, and the correlation of their sums.
"""

from collections.abc import Iterator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from lare_rl.algorithms.registry import ALGORITHMS
from lare_rl.config.train_config import TrainConfig
from lare_rl.credit import arel
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import METHODS
from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.particles.particle_env import ParticleEnv
from lare_rl.envs.particles.task import MAX_STEPS
from lare_rl.evaluation.played_episodes import compute_proxy_rewards, unroll_policy
from lare_rl.training import learner as learner_module
from lare_rl.training.compiled import compile_functions
from lare_rl.training.decoder_fits import update_repeatedly
from lare_rl.training.learner import Learner
from lare_rl.training.policy import get_actor
from lare_rl.training.seed_axis import select_seed
from measure import apart, correlation, write

ENV, STORED, TEST_EPISODES, AT_A_TIME = ParticleEnv("CN-6"), 1600, 200, 100
CONTENDERS = {"rd": (None, 3200), "arel": (None, 3200), "arel without its penalty": (0.0, 800)}
"""The weight of AREL's penalty (None: the published one), and the number of updates."""


def make_config(name: str) -> TrainConfig:
    """The configuration of a contender. Each episode is stored in its own environment."""
    ippo = ALGORITHMS["ippo"]
    return TrainConfig(
        env=ENV.spec,
        credit_scope="observation",
        scored_observation="after",
        method=METHODS.find(name),
        consumes=ippo.consumes,
        algorithm=ippo,
        hyperparameters=ippo.settings,
        credit=CreditSettings(batch_steps=32 * MAX_STEPS),
        scale_rewards=False,
        n_factors=(),
        n_envs=STORED,
        rollout_steps=MAX_STEPS,
        capacity=3 * MAX_STEPS,
        steps=1,
        fit_updates=AT_A_TIME,
    )


def no_factors(episodes: int) -> np.ndarray:
    return np.zeros((MAX_STEPS, episodes, ENV.spec.n_agents, 0), np.float32)


def random_episodes(key: int, count: int, config: TrainConfig) -> Trajectory:
    """Episodes of random actions, by networks of zeros, which have no preference."""
    actor = get_actor(compile_functions(config).init(jax.random.key(0)[None]).algorithm, 0, config)
    return unroll_policy(ENV, config, jax.tree.map(jnp.zeros_like, actor), count, key).steps


def correlations(learner: Learner, steps: Trajectory, config: TrainConfig) -> tuple[float, float]:
    """Correlation within an episode, and of returns."""
    r_hat = compute_proxy_rewards(learner, steps, no_factors(TEST_EPISODES), config)
    true_reward, proxy_reward = (
        rewards.swapaxes(0, 1).mean(2) for rewards in (np.asarray(steps.next_timestep.reward), r_hat)
    )
    within = correlation(apart(true_reward), apart(proxy_reward))
    return round(within, 3), round(correlation(true_reward.sum(1), proxy_reward.sum(1)), 3)


def curve(name: str, updates: int) -> Iterator[tuple[int, tuple[float, float]]]:
    config = make_config(name)
    learner = select_seed(compile_functions(config).init(jax.random.key(0)[None]))
    steps, factors = random_episodes(1, STORED, config), jnp.asarray(no_factors(STORED))
    learner = learner_module.store_with_factors(learner, steps, factors, config)
    test_steps = random_episodes(99, TEST_EPISODES, config)
    fit = jax.jit(partial(update_repeatedly, config=config))
    for done in range(AT_A_TIME, updates + 1, AT_A_TIME):
        credit, _ = fit(learner, jax.random.key(done))
        learner = learner._replace(decoders=credit)
        if (done // AT_A_TIME).bit_count() == 1:
            yield done, correlations(learner, test_steps, config)


def main() -> None:
    results: dict[str, dict[int, tuple[float, float]]] = {}
    published = arel.VARIANCE_PENALTY
    for name, (penalty, updates) in CONTENDERS.items():
        arel.VARIANCE_PENALTY = published if penalty is None else penalty
        results[name] = {}
        for done, figures in curve(name.split()[0], updates):
            results[name][done] = figures
            print(
                f"{name:26s} {done:5d} updates: within an episode {figures[0]:.2f}, returns {figures[1]:.2f}",
                flush=True,
            )
    write("decoder_updates", {"task": "CN-6", "by contender and updates: within an episode, of returns": results})


if __name__ == "__main__":
    main()
