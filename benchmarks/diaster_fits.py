"""How many fits Diaster's decoder takes: on the replay of a finished run, beside RD's.

    python benchmarks/diaster_fits.py RUN [--fits 100 800 3200] [--seeds 3]

New decoders, one for each of the run's first seeds, are fitted to the episodes that it stored: data that stays. After so many
fits in all: mean |r_hat - r| and the correlation over the last 5,000 steps, and what the first step of an episode is said to pay.
In a run Diaster gets one fit for 50 updates of the policy, RD one for each.
"""

import dataclasses
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import tyro
from measure import write

from lare.credit import accuracy, decomposition
from lare.credit.accuracy import RECENT
from lare.credit.decomposition import CreditSettings
from lare.credit.methods import METHODS
from lare.training import learner as common
from lare.training import replay
from lare.training.learner import Learner
from lare.training.recipe import Recipe
from lare.training.run import open_run
from lare.training.seeds import of_seed
from lare.training.single_agent import load_learner


def untrained(learner: Learner, recipe: Recipe, key: jax.Array) -> Learner:
    """With a new decoder, which knows the statistics of all that is stored."""
    credit = decomposition.init(
        key, recipe.features, recipe.method, recipe.credit, steps=recipe.longest_episode, agents=1
    )
    held = learner.replay
    every = replay.read(held, jnp.arange(int(replay.oldest_transition(held)), int(held.transitions)))
    credit = decomposition.observe_steps(credit, common.features(every, recipe.method))
    return learner._replace(credit=credit._replace(scale=learner.scale))


def curve(learner: Learner, recipe: Recipe, fits: tuple[int, ...], seed: int) -> list[dict[str, float]]:
    """What the decoder is worth after so many fits."""
    learner, found, begin = untrained(learner, recipe, jax.random.key(seed)), [], time.perf_counter()
    number = learner.replay.transitions - 1 - jnp.arange(RECENT)
    recent = replay.read(learner.replay, number)
    first = jnp.isin(number, learner.replay.first)
    every = jnp.ones(RECENT, bool)
    some = jax.jit(common.fit_often, static_argnames=("updates", "recipe"))
    done = 0
    for wanted in fits:
        while done < wanted:
            learner, _ = some(learner, jax.random.key(1000 * seed + done), updates=50, recipe=recipe)
            done += 50
        r_hat = common.proxy_rewards(recent, learner, recipe)
        found.append(
            {
                "fits": done,
                "correlation": float(accuracy.correlation(r_hat, recent.reward, every)),
                "error": float(accuracy.mean_error(r_hat, recent.reward, every)),
                "r_hat of the first step": float(r_hat[first].mean()),
                "r of the first step": float(recent.reward[first].mean()),
                "return": float(recent.mean_reward.mean() * recipe.longest_episode),
                "seconds": time.perf_counter() - begin,
            }
        )
    return found


def main(directory: tyro.conf.Positional[Path], fits: tuple[int, ...] = (100, 800, 3200), seeds: int = 3) -> None:
    """Measure.

    Args:
        directory: a run of a single agent and a method that stores raw features, finished.
        fits: numbers of fits in all, multiples of 50.
        seeds: of the run's.
    """
    run = open_run(directory)
    recipe, everyone, _, _ = load_learner(run)
    results = {}
    for name in ("diaster", "rd"):
        chosen = dataclasses.replace(recipe, method=METHODS[name], credit=CreditSettings())
        results[name] = [curve(of_seed(everyone, seed), chosen, fits, seed) for seed in range(seeds)]
        for of_one in results[name]:
            print(
                name,
                "  ".join(f"{at['fits']}: {at['correlation']:.2f} ({at['error']:.3g})" for at in of_one),
                flush=True,
            )
    write(
        "diaster_fits",
        {"task": run.config.task.name, "stored by": run.config.settings.method, "results": results},
    )


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")
    tyro.cli(main, description=__doc__)
