"""How much the decoders of many agents tell of single steps after so many updates, on data that stays as it is.

    python benchmarks/decoder_updates.py

1,600 episodes of random actions on CN-6, one seed, updates on 32 episodes each. Judged on 200 other episodes: the correlation of
proxy and true rewards, both as means over the agents, as deviations from their episode's mean, and of their sums.
"""

from collections.abc import Iterator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from measure import apart, correlation, write

from lare.credit import arel
from lare.credit.decomposition import CreditSettings
from lare.credit.methods import find_method
from lare.experiments.agents import indifferent
from lare.tasks.particles.table import find_particle_task
from lare.tasks.particles.task import STEPS
from lare.training import teams
from lare.training.settings import AgentSettings, Settings
from lare.training.teams import Learner, Played, Recipe

TASK, STORED, JUDGED, AT_A_TIME = find_particle_task("CN-6"), 1600, 200, 100
CONTENDERS = {"rd": (None, 3200), "arel": (None, 3200), "arel without its penalty": (0.0, 800)}
"""The weight of AREL's penalty, if it is not the published one, and updates."""
SETTINGS = AgentSettings(fit_updates=AT_A_TIME, capacity=STORED, credit=CreditSettings(steps=32 * STEPS))


def no_factors(episodes: int) -> jax.Array:
    return jnp.zeros((STEPS, episodes, TASK.agents, 0))


def random_episodes(learner: Learner, key: int, count: int, recipe: Recipe) -> Played:
    play = jax.jit(partial(teams.play, count=count, recipe=recipe))
    return play(indifferent(learner.algorithm.online.actor), jax.random.key(key))


def judged(learner: Learner, played: Played, recipe: Recipe) -> tuple[float, float]:
    """Correlation within an episode, and of returns."""
    true = jnp.swapaxes(played.reward, 0, 1)
    rows = teams.features(played, no_factors(JUDGED), recipe)
    r_hat = teams.rewards(learner, rows, true, recipe)
    one, other = np.asarray(true).mean(2), np.asarray(r_hat).mean(2)
    within = correlation(apart(one), apart(other))
    return round(within, 3), round(correlation(one.sum(1), other.sum(1)), 3)


def curve(name: str, updates: int) -> Iterator[tuple[int, tuple[float, float]]]:
    recipe = Recipe(TASK, find_method(name), Settings().ippo, SETTINGS, ())
    learner = teams.init(jax.random.key(0), recipe)
    learner = teams.store(learner, random_episodes(learner, 1, STORED, recipe), no_factors(STORED), recipe)
    others = random_episodes(learner, 99, JUDGED, recipe)
    fit = jax.jit(partial(teams.fit, recipe=recipe))
    for done in range(AT_A_TIME, updates + 1, AT_A_TIME):
        credit, _ = fit(learner, jax.random.key(done))
        learner = learner._replace(credit=credit)
        if (done // AT_A_TIME).bit_count() == 1:
            yield done, judged(learner, others, recipe)


def main() -> None:
    found: dict[str, dict[int, tuple[float, float]]] = {}
    published = arel.VARIANCE_PENALTY
    for name, (penalty, updates) in CONTENDERS.items():
        arel.VARIANCE_PENALTY = published if penalty is None else penalty
        found[name] = {}
        for done, figures in curve(name.split()[0], updates):
            found[name][done] = figures
            print(
                f"{name:26s} {done:5d} updates: within an episode {figures[0]:.2f}, returns {figures[1]:.2f}",
                flush=True,
            )
    write("decoder_updates", {"task": "CN-6", "by contender and updates: within an episode, of returns": found})


if __name__ == "__main__":
    main()
