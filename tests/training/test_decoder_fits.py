"""Updates of decoders in chunks of a large batch, and of all seeds at once."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest

from helpers.numpy_twins import assert_close
from helpers.small_configs import (
    ONE_AGENT,
    add_steps,
    learner_with_episodes,
    random_steps,
    small_config,
    untrained_learner,
)
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.training import batching, decoder_fits
from lare_rl.training.decoder_fits import fit_decoders, fit_seeds, sample_credit


def test_update_in_chunks_is_that_of_the_batch(monkeypatch):
    """Six episodes of twelve steps, in three chunks of two episodes."""
    env = replace(ONE_AGENT, fixed_length=True)
    config = small_config("rd", env=env, credit=CreditSettings(hidden=(8,), steps=72, learning_rate=0.1))
    learner = add_steps(untrained_learner(config), config, random_steps(env, lengths=(12,) * 8))
    sample = jax.tree.map(lambda leaf: leaf[0], sample_credit(learner.replay, jax.random.key(0), 1, config))
    assert sample.episodes.length.shape == (6,)
    results = []
    for rows in (72, 24):
        monkeypatch.setattr(decoder_fits, "CHUNK_ROWS", rows)
        update = jax.jit(partial(fit_decoders, config=config))
        results.append(update(learner.decoders, learner.replay, sample, jax.random.key(1)))
    assert_close(*results, 1e-3, 1e-6)


def test_seeds_are_fitted_at_once_or_one_after_the_other():
    config = small_config("rd", fit_updates=2)
    seeds = jax.tree.map(lambda *leaves: np.stack(leaves), *(learner_with_episodes(config, seed) for seed in (0, 1)))
    results = []
    for batched in (False, True):
        fit = jax.jit(partial(fit_seeds, config=replace(config, batched=batched)))
        results.append(fit(seeds, jax.random.split(jax.random.key(0))))
    assert_close(*results, 1e-3, 1e-6)


@pytest.mark.parametrize(
    ("backend", "seconds", "expected"), [("cpu", 9, False), ("card", 1.5, False), ("card", 9, True)]
)
def test_seeds_are_fitted_at_once_where_that_is_much_faster(backend, seconds, expected, monkeypatch):
    times_s = iter((seconds, 1.0))
    monkeypatch.setattr(batching.jax, "default_backend", lambda: backend)
    monkeypatch.setattr(batching, "_measure_s", lambda function, matrices: next(times_s))
    assert batching.is_batching_faster(small_config("bayes"), 2) == expected
