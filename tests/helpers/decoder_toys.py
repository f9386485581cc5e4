"""Decoders for tests, and what their losses have in common (`from helpers.decoder_toys import ...`)."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from lare_rl.credit import decoder_state, descent
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decoder_state import CreditBatch
from lare_rl.credit.decoders import DECODERS
from lare_rl.credit.input_names import InputNames
from lare_rl.credit.methods import METHODS
from lare_rl.credit.spec import CreditSpec
from lare_rl.nn.networks import adam_step, init_adam


def make_decoder(name, sizes, steps, agents=1, seed=0, **settings):
    """Return an untrained decoder for inputs of these sizes, which is one number or numbers by names."""
    sizes = sizes if isinstance(sizes, dict) else {"observation": sizes}
    spec = CreditSpec(
        method=replace(METHODS["rd"], inputs=InputNames(tuple(sizes)), decoder=name),
        settings=CreditSettings(**settings),
        observation_size=sizes["observation"],
        action_size=sizes.get("action", 0),
        single_agent=agents == 1,
        agents=agents,
        max_steps=steps,
    )
    return DECODERS[name].load_init()(jax.random.key(seed), spec)


def random_rows(*shape):
    return np.random.default_rng(0).normal(size=shape).astype(np.float32)


TARGET, MASK = np.float32([1, -0.5, 2, 0.3]), np.float32([1, 1, 0, 1])


def check_loss(decoder, rows, length, episode_loss, key=None):
    """Assert that the loss of four episodes, of which the third is padding, is the mean of a twin's losses of the others."""
    key = jax.random.key(0) if key is None else key
    loss = jax.jit(lambda *args: decoder.loss(*args))(rows, jnp.asarray(length), TARGET, MASK, key)
    want = [episode_loss(rows[i, : length[i]], TARGET[i], i) for i in (0, 1, 3)]
    np.testing.assert_allclose(loss, np.mean(want), rtol=1e-3)


def train_by_loss(decoder, rows, target, learning_rate):
    """Make an update by the decoder's own loss for each of some batches of episodes of one length."""
    length, mask = jnp.full(rows.shape[1], rows.shape[2]), jnp.ones(rows.shape[1])

    def body(state, batch):
        (decoder, optimizer), (x, target, key) = state, batch
        gradient = jax.grad(lambda decoder: decoder.loss(x, length, target, mask, key))(decoder)
        return adam_step(decoder, gradient, optimizer, learning_rate), None

    @jax.jit
    def train(decoder, *batches):
        return jax.lax.scan(body, (decoder, init_adam(decoder, learning_rate)), batches)[0][0]

    return train(decoder, rows, target, jax.random.split(jax.random.key(0), len(rows)))


@partial(jax.jit, static_argnames="spec")
def observed_state(spec, rows, mean_reward, length, key):
    """Return an untrained decoder that has observed these steps, and the mean rewards of episodes."""
    state = decoder_state.observe_steps(decoder_state.init(key, spec), rows)
    return decoder_state.observe_returns(state, mean_reward, length, jnp.ones(len(length), bool), None)


def whole_batches(rows, mean_reward, length):
    """Return batches of episodes. The first axes of the rows are updates, episodes, and the steps of an episode that are read."""
    updates, n_episodes, n_steps = rows.shape[:3]
    return CreditBatch(
        inputs=rows.reshape(updates, n_episodes * n_steps, *rows.shape[3:]),
        episode_index=np.tile(np.repeat(np.arange(n_episodes), n_steps), (updates, 1)),
        length=np.full((updates, n_episodes), length),
        mean_reward=np.broadcast_to(mean_reward, (updates, n_episodes)).astype(np.float32),
        mask=np.ones((updates, n_episodes), np.float32),
    )


@partial(jax.jit, static_argnames="spec")
def fit_batches(state, batches, spec):
    """Make an update by each of some batches. Return the state and the losses."""

    def body(state, batch):
        state, metrics = descent.update(state, *batch, spec)
        return state, metrics["credit/loss"]

    return jax.lax.scan(body, state, (batches, jax.random.split(jax.random.key(0), len(batches.length))))


decoder_rewards = jax.jit(decoder_state.decoder_rewards, static_argnames="spec")
