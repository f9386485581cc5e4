"""Decoders are updated by gradients: in chunks, for all seeds at once, and in the first fit for many agents.

In the first fit, held-out episodes are not fitted to, and each seed keeps its best decoder.
"""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.numpy_twins import assert_close
from helpers.small_configs import (
    ONE_AGENT,
    ONE_TEAM,
    add_steps,
    learner_with_episodes,
    random_steps,
    small_config,
    untrained_learner,
    with_factor_decoders,
)
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.data import replay
from lare_rl.training import decoder_fits
from lare_rl.training.decoder_fits import (
    PATIENCE,
    FirstFitStoppedError,
    config_of_first_fit,
    fit_until_converged,
    sample_credit,
    update_all_seeds,
    update_decoders,
)


def stack_seeds(*seeds):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *seeds)


@pytest.mark.long
def test_update_in_chunks_is_that_of_the_batch(monkeypatch):
    """Six episodes of twelve steps, in three chunks of two episodes."""
    env = replace(ONE_AGENT, fixed_length=True)
    config = small_config("rd", env=env, credit=CreditSettings(hidden=(8,), batch_steps=72, learning_rate=0.1))
    learner = add_steps(untrained_learner(config), config, random_steps(env, lengths=(12,) * 8))
    sample = jax.tree.map(lambda leaf: leaf[0], sample_credit(learner.replay, jax.random.key(0), 1, config))
    assert sample.episodes.length.shape == (6,)
    results = []
    for rows in (72, 24):
        monkeypatch.setattr(decoder_fits, "CHUNK_ROWS", rows)
        update = jax.jit(partial(update_decoders, config=config))
        results.append(update(learner.decoders, learner.replay, sample, jax.random.key(1)))
    assert_close(*results, 1e-3, 1e-6)


def test_seeds_are_fitted_at_once_or_one_after_the_other():
    config, keys = small_config("rd", fit_updates=2), jax.random.split(jax.random.key(0))
    seeds = stack_seeds(*(learner_with_episodes(config, seed) for seed in (0, 1)))
    fits = (
        jax.jit(partial(update_all_seeds, config=replace(config, vectorized=vectorized)))
        for vectorized in (False, True)
    )
    assert_close(*(fit(seeds, keys) for fit in fits), 1e-3, 1e-6)


# The first fit.


def test_count_held_out_and_config_of_first_fit():
    """It reads an eighth of the steps."""
    for n_episodes, n_held_out in (
        ((10,), [2]),
        ((1,) * 10, [0] * 8 + [1] * 2),
        ((3, 3, 3, 3), [0, 0, 0, 2]),
        ((4, 0, 6), [0, 0, 2]),
        ((999,), [32]),
    ):
        buffer = replay.init_replay({}, len(n_episodes), 100, 1)._replace(current_episode=jnp.array(n_episodes))
        assert decoder_fits._count_held_out(buffer, window=32).tolist() == n_held_out
    for steps, first in ((6400, 800), (400, 50), (80, 12), (10, 10)):
        config = small_config("lare-rd", credit=CreditSettings(batch_steps=steps))
        assert config_of_first_fit(config).credit.batch_steps == first


@pytest.mark.long
def test_fit_until_converged_keeps_the_best_decoders():
    """The only factor is the true reward, so a decoder's error is the distance of its weight from 1."""
    config = small_config("lare-linear", "ippo", ONE_TEAM, n_factors=(1,), n_envs=10)
    steps = random_steps(ONE_TEAM, 10, lengths=(12,))
    learner = add_steps(untrained_learner(config), config, steps, steps.next_timestep.reward[..., None], learn=False)
    fitted = learner.decoders[0].closed_form._replace(n_fitted=jnp.array(2.0))  # only then returns are predicted
    learner = learner._replace(decoders=(learner.decoders[0]._replace(closed_form=fitted),))
    errors, rounds = [[3.0, 3.0], [1.0, 4.0], [2.0, 2.0], [5.0, 5.0], [0.0, 6.0]], []

    def fit(learner, keys):
        seeds = [jax.tree.map(lambda leaf, seed=seed: leaf[seed], learner) for seed in (0, 1)]
        pairs = zip(seeds, errors[len(rounds)], strict=True)
        fitted = stack_seeds(*[with_factor_decoders(seed, [1 + error]) for seed, error in pairs])
        n_episodes = np.asarray(learner.replay.current_episode).sum(axis=1).tolist()
        rounds.append((n_episodes, jax.random.key_data(keys).tolist()))
        return fitted, {"credit/loss": jnp.array(errors[len(rounds) - 1])}

    keys = jax.random.split(jax.random.key(0), 2)
    fitted, metrics = fit_until_converged(stack_seeds(learner, learner), fit, keys, config, lambda: False)
    assert len(rounds) == 3 + PATIENCE
    assert all(n_episodes == [8, 8] for n_episodes, _ in rounds)
    assert len({str(keys) for _, keys in rounds}) == len(rounds)
    # The first seed has stopped before its error would have fallen again.
    np.testing.assert_array_equal(fitted.decoders[0].network.weight, [[2.0], [3.0]])
    np.testing.assert_array_equal(fitted.replay.current_episode, [learner.replay.current_episode] * 2)
    np.testing.assert_array_equal(fitted.replay.running, [learner.replay.running] * 2)
    np.testing.assert_array_equal(metrics["credit/loss"], [1.0, 2.0])
    with pytest.raises(FirstFitStoppedError):
        fit_until_converged(stack_seeds(learner, learner), fit, keys, config, lambda: True)
