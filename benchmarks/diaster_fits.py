"""How many fits Diaster's decoder needs, compared with RD's, on the replay of a finished run.

    python benchmarks/diaster_fits.py RUN [--fits 100 800 3200] [--seeds 3]

New decoders, one for each of the run's first seeds, are fitted to its stored episodes, which do not change. After each number of
fits: mean |r_hat - r| and the correlation over the last 5,000 steps, and r_hat of the first step of an episode. In training,
Diaster gets one fit for 50 updates of the policy, RD one for each.
"""

import dataclasses
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import tyro

from lare_rl.config.train_config import TrainConfig
from lare_rl.credit import decoder_state
from lare_rl.credit.decoder_settings import RECENT_STEPS, CreditSettings
from lare_rl.credit.methods import METHODS
from lare_rl.credit.rewards import proxy_rewards
from lare_rl.data import replay
from lare_rl.runs.directory import open_run
from lare_rl.training.decoder_fits import update_repeatedly
from lare_rl.training.decoder_inputs import decoder_inputs, step_batch
from lare_rl.training.learner import Learner
from lare_rl.training.rewards import masked_correlation, mean_absolute_error
from lare_rl.training.saved_state import load_learner
from lare_rl.training.seed_axis import select_seed
from measure import write

AT_A_TIME = 50
"""Fits in a compiled call."""


def untrained(learner: Learner, config: TrainConfig, key: jax.Array) -> Learner:
    """The learner with a new decoder, which has the statistics of all stored steps."""
    credit = decoder_state.init(key, config.credit_specs[0])
    stored_replay = learner.replay
    valid = replay.read(
        stored_replay, replay.newest_steps(stored_replay, int(replay.n_stored_transitions(stored_replay)[0]))
    )
    credit = decoder_state.observe_steps(credit, decoder_inputs(valid, config, 0))
    return learner._replace(decoders=(credit._replace(scale=learner.decoders[0].scale),))


def curve(learner: Learner, config: TrainConfig, fits: tuple[int, ...], seed: int) -> list[dict[str, float]]:
    """The accuracy of the decoder after each number of fits."""
    learner, accuracies, begin = untrained(learner, config, jax.random.key(seed)), [], time.perf_counter()
    index = replay.newest_steps(learner.replay, RECENT_STEPS)
    recent = jax.tree.map(lambda rows: rows[0], replay.read(learner.replay, index))
    first = jnp.isin(index.number[0], learner.replay.first)
    reward, valid = recent.columns["reward"][:, 0], jnp.ones(RECENT_STEPS, bool)
    fit_some = jax.jit(update_repeatedly, static_argnames="config")
    done = 0
    for n_fits in fits:
        while done < n_fits:
            credit, _ = fit_some(learner, jax.random.key(1000 * seed + done), config=config)
            learner = learner._replace(decoders=credit)
            done += AT_A_TIME
        r_hat = proxy_rewards(learner.decoders[0], step_batch(recent, config, 0), config.credit_specs[0])[:, 0]
        accuracies.append(
            {
                "fits": done,
                "correlation": float(masked_correlation(r_hat, reward, valid)),
                "error": float(mean_absolute_error(r_hat, reward, valid)),
                "r_hat of the first step": float(r_hat[first].mean()),
                "r of the first step": float(reward[first].mean()),
                "return": float(recent.mean_reward.mean() * config.env.max_steps),
                "seconds": time.perf_counter() - begin,
            }
        )
    return accuracies


def main(directory: tyro.conf.Positional[Path], fits: tuple[int, ...] = (100, 800, 3200), seeds: int = 3) -> None:
    """Measure.

    Args:
        directory: a finished run of a single agent, with a method that stores raw features.
        fits: total numbers of fits, multiples of 50.
        seeds: number of the run's seeds to use.
    """
    run = open_run(directory)
    config, everyone, _, _ = load_learner(run)
    results = {}
    for name in ("diaster", "rd"):
        chosen = dataclasses.replace(config, method=METHODS[name], credit=CreditSettings(), fit_updates=AT_A_TIME)
        results[name] = [curve(select_seed(everyone, seed), chosen, fits, seed) for seed in range(seeds)]
        for seed_rows in results[name]:
            print(
                name,
                "  ".join(f"{at['fits']}: {at['correlation']:.2f} ({at['error']:.3g})" for at in seed_rows),
                flush=True,
            )
    write(
        "diaster_fits",
        {"task": run.config.task.name, "stored by": run.config.settings.method, "results": results},
    )


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")
    tyro.cli(main, description=__doc__)
