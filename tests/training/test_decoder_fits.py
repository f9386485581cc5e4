"""A decoder's update in chunks of a large batch."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np

from helpers.small_configs import ONE_AGENT, add_steps, random_steps, small_config, untrained_learner
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.training import decoder_fits
from lare_rl.training.decoder_fits import fit_decoders, sample_credit


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
    for batch, chunks in zip(*map(jax.tree.leaves, results), strict=True):
        np.testing.assert_allclose(batch, chunks, rtol=1e-3, atol=1e-6)
