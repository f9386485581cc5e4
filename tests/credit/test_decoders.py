"""What every decoder keeps: shapes, causality, what it draws and when; and the equations of its own."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.tiers import long
from lare_rl.credit import decomposition, descent
from lare_rl.credit.arel import AREL, Block
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decoders import Bottleneck, StepDecoder
from lare_rl.credit.decomposition import Episodes
from lare_rl.credit.methods import TABLE, Decoder, Fit
from lare_rl.credit.stas import STAS, USED, Coalitions, TimeLayer, dropout
from lare_rl.nn.attention import LayerNorm, attend, causal

EPISODES, STEPS, AGENTS, FEATURES = 4, 5, 3, 6
KEY = jax.random.key(1)
KINDS = {
    "step": partial(StepDecoder, FEATURES, (8,), 2.0),
    "bottleneck": partial(Bottleneck, FEATURES, (16,), 2, (8,), 0.1, 2.0),
    "arel": partial(AREL, FEATURES, STEPS),
    "stas": partial(STAS, FEATURES, STEPS, AGENTS, 2.0),
}


def made(kind):
    return KINDS[kind](key=KEY)


@pytest.fixture(params=KINDS)
def decoder(request):
    return made(request.param)


@jax.jit
def decode(decoder, rows, key=None):
    return decoder(rows, key)


def features(seed=0):
    rows = np.random.default_rng(seed).normal(size=(EPISODES, STEPS, AGENTS, FEATURES))
    return jnp.asarray(rows, jnp.float32).reshape(-1, AGENTS, FEATURES)


def by_episode(r_hat):
    return np.asarray(r_hat).reshape(EPISODES, STEPS, AGENTS)


def test_one_proxy_reward_for_each_agent_at_each_step(decoder):
    for key in (None, KEY):
        decoded = decode(decoder, features(), key)
        assert decoded.r_hat.shape == (EPISODES * STEPS, AGENTS)
        assert np.isfinite(decoded.r_hat).all()
        assert decoded.penalty.shape == (EPISODES * STEPS, AGENTS)
        assert (np.asarray(decoded.penalty) >= 0).all()


def test_at_use_nothing_is_drawn(decoder):
    np.testing.assert_array_equal(decode(decoder, features()).r_hat, decode(decoder, features()).r_hat)


@pytest.mark.parametrize(("name", "draws"), [("step", False), ("bottleneck", True), ("arel", False), ("stas", True)])
def test_who_draws_while_learning(name, draws):
    one, other = (decode(made(name), features(), jax.random.key(number)).r_hat for number in (1, 2))
    assert (np.abs(one - other).max() > 1e-6) == draws


def test_what_comes_later_changes_nothing(decoder):
    """Credit is causal: neither the next steps nor other episodes matter."""
    given = features().reshape(EPISODES, STEPS, AGENTS, FEATURES)
    changed = given.at[:, 3:].set(7.0).at[1].set(-7.0)
    before, after = (by_episode(decode(decoder, rows.reshape(-1, AGENTS, FEATURES)).r_hat) for rows in (given, changed))
    np.testing.assert_allclose(before[0, :3], after[0, :3], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(before[2:, :3], after[2:, :3], rtol=1e-4, atol=1e-5)
    assert np.abs(before[1] - after[1]).max() > 1e-4


def test_a_bottleneck_costs_its_divergence():
    bottleneck = made("bottleneck")
    mean, log_variance = np.split(np.asarray(bottleneck.encoder(features())), 2, axis=-1)
    want = 0.1 * 0.5 * (np.exp(log_variance) + mean**2 - 1 - log_variance).sum(axis=-1).mean()
    assert float(bottleneck(features(), KEY).penalty.mean()) == pytest.approx(want, rel=1e-5)


def test_a_bottleneck_draws_its_code_from_a_gaussian():
    bottleneck, noise = made("bottleneck"), jax.random.normal(KEY, (EPISODES * STEPS, AGENTS, 2))
    mean, log_variance = jnp.split(bottleneck.encoder(features()), 2, axis=-1)
    assert float(jnp.abs(log_variance).max()) > 0.1
    for key, code in ((KEY, mean + jnp.sqrt(jnp.exp(log_variance)) * noise), (None, mean)):
        want = bottleneck.decoder(code, None).r_hat
        np.testing.assert_allclose(bottleneck(features(), key).r_hat, want, rtol=1e-4, atol=1e-5)


def test_arel_gives_every_agent_the_same_and_costs_its_variance():
    decoded = made("arel")(features(), None)
    given = by_episode(decoded.r_hat)
    np.testing.assert_array_equal(given, np.broadcast_to(given[..., :1], given.shape))
    want = 20 / STEPS**2 * given[..., 0].var(axis=1, ddof=1).mean()
    assert float(decoded.penalty.mean()) == pytest.approx(want, rel=1e-4)


@pytest.mark.parametrize(("normalise", "sum_form"), [long(False, True), (True, False)])
def test_arels_loss_is_the_published_one_in_other_units(normalise, sum_form):
    """(R - sum_t y_t)^2 + 20 Var_t(y), as published, divided by T^2 for the mean form and by the square of the scale."""
    settings = CreditSettings(normalise=normalise, sum_form=sum_form)
    method = next(method for method in TABLE if method.name == "arel")
    mean_reward, length = np.float32([3.0, -1.0, 2.0, 0.5]), np.full(EPISODES, STEPS)

    @jax.jit
    def measured():
        state = decomposition.init(KEY, FEATURES, method, settings, STEPS, AGENTS)
        state = decomposition.observe_steps(state, features())
        state = decomposition.observe_returns(
            state, jnp.asarray(mean_reward), jnp.asarray(length), jnp.ones(EPISODES, bool)
        )
        episode = jnp.repeat(jnp.arange(EPISODES), STEPS)
        batch = Episodes(features(), episode, jnp.asarray(length), jnp.asarray(mean_reward), jnp.ones(EPISODES))
        _, metrics = descent.update(state, batch, KEY, method.fit, settings)
        return decomposition.proxy_rewards(state, features(), settings), metrics["credit/loss"]

    y, loss = map(np.asarray, measured())
    y = by_episode(y)[..., 0]
    published = ((STEPS * mean_reward - y.sum(axis=1)) ** 2).mean() + 20 * y.var(axis=1, ddof=1).mean()
    unit = float(np.mean(mean_reward**2)) if normalise else 1.0
    assert float(loss) * unit * (1 if sum_form else STEPS**2) == pytest.approx(float(published), rel=1e-4)


def test_arel_cares_not_which_agent_is_which():
    given = decode(made("arel"), features()).r_hat
    np.testing.assert_allclose(given, decode(made("arel"), features()[:, ::-1]).r_hat, rtol=1e-4, atol=1e-5)


def attended(query, key, value, mask):
    """Attention in plain sums: (queries, heads, size), (tokens, heads, size) twice, (queries, tokens)."""
    found = np.zeros_like(query)
    for token, head in np.ndindex(query.shape[:2]):
        seen = mask[token]
        scores = key[seen, head] @ query[token, head] / np.sqrt(query.shape[-1])
        found[token, head] = np.exp(scores) / np.exp(scores).sum() @ value[seen, head]
    return found.reshape(len(query), -1)


@pytest.mark.parametrize("batch", [(), (2,), (3, 2)])
@pytest.mark.parametrize("queries", [4, 7])
def test_attention_against_plain_sums(batch, queries):
    rng = np.random.default_rng(0)
    query, key, value = (rng.normal(size=(*batch, tokens, 2, 3)).astype(np.float32) for tokens in (queries, 4, 4))
    mask = np.asarray(causal(4)) if queries == 4 else (rng.random((queries, 4)) < 0.5) | (np.arange(4) == 0)
    got = attend(jnp.asarray(query), jnp.asarray(key), jnp.asarray(value), jnp.asarray(mask))
    for place in np.ndindex(batch):
        np.testing.assert_allclose(got[place], attended(query[place], key[place], value[place], mask), 1e-4, 1e-5)


def affine(layer, x):
    return x @ np.asarray(layer.weight) + np.asarray(layer.bias)


def standardised(rows, epsilon):
    return (rows - rows.mean(axis=1, keepdims=True)) / np.sqrt(rows.var(axis=1, keepdims=True) + epsilon)


def test_a_layer_over_time_of_stas_against_plain_sums():
    """Its input is not added again after the feed-forward part, and the attention is added twice."""
    layer = TimeLayer(key=KEY)
    x = np.random.default_rng(0).normal(size=(STEPS, 128)).astype(np.float32)
    parts = [affine(part, x).reshape(STEPS, 4, 32) for part in (layer.query, layer.key, layer.value)]
    a = affine(layer.merge, attended(*parts, np.tri(STEPS, dtype=bool)))
    hidden = affine(layer.feed_forward.layers[0], standardised(x + a, 1e-12))
    hidden *= 0.5 * (1 + np.vectorize(math.erf)(hidden / np.sqrt(2)))
    want = standardised(affine(layer.feed_forward.layers[1], hidden) + 2 * a, 1e-12)
    np.testing.assert_allclose(layer(jnp.asarray(x), None), want, rtol=1e-3, atol=1e-4)


def test_a_block_of_arel_against_plain_sums():
    block = Block(FEATURES, key=KEY)
    x = np.random.default_rng(0).normal(size=(STEPS, FEATURES)).astype(np.float32)
    parts = [part.reshape(STEPS, 3, FEATURES) for part in np.split(x @ np.asarray(block.projections), 3, axis=1)]
    y = standardised(x + affine(block.merge, attended(*parts, np.tri(STEPS, dtype=bool))), 1e-5)
    fed = affine(block.feed_forward.layers[1], np.maximum(affine(block.feed_forward.layers[0], y), 0))
    np.testing.assert_allclose(block(jnp.asarray(x), causal(STEPS)), standardised(y + fed, 1e-5), rtol=1e-3, atol=1e-4)


def test_coalitions_against_plain_sums():
    """The mean over coalitions of attention with queries of each agent's own."""
    layer, key = Coalitions(AGENTS, key=KEY), jax.random.key(1)
    x = np.random.default_rng(0).normal(size=(AGENTS, 128)).astype(np.float32)
    query = np.stack([x[i] @ layer.query.weight[i] + layer.query.bias[i] for i in range(AGENTS)])
    projected = query, *(x @ linear.weight + linear.bias for linear in (layer.key, layer.value))
    parts = [np.asarray(part).reshape(AGENTS, 4, 32) for part in projected]
    masks = np.asarray(jax.random.bernoulli(key, 0.5, (5, AGENTS, AGENTS))) | np.eye(AGENTS, dtype=bool)
    want = np.mean([attended(*parts, mask) @ layer.merge.weight + layer.merge.bias for mask in masks], axis=0)
    np.testing.assert_allclose(layer(jnp.asarray(x), key, None), want, rtol=1e-4, atol=1e-5)


def test_dropout_tosses_a_coin_for_each_entry():
    kept = np.asarray(dropout(jnp.ones((50, 20, 13)), KEY))
    assert set(np.unique(kept)) == {0, 2}
    assert np.abs(kept.mean(axis=0) - 1).max() < 0.75  # over 50: 5 standard deviations
    assert np.abs(np.corrcoef(kept.reshape(-1, 13).T) - np.eye(13)).max() < 0.2
    np.testing.assert_array_equal(dropout(jnp.ones(3), None), 1)


def test_stas_at_use_is_a_mean_over_draws():
    """Which is nearer to the mean over many than a single draw is."""
    stas, x = made("stas"), jnp.asarray(np.random.default_rng(0).normal(size=(2, STEPS, AGENTS, 128)), jnp.float32)
    draws = np.stack([stas.among_agents(x, key, None) for key in jax.random.split(jax.random.key(5), 60)])
    used = np.mean([stas.among_agents(x, key, None) for key in jax.random.split(jax.random.key(0), USED)], axis=0)
    mean = draws.mean(axis=0)
    assert np.abs(used - mean).mean() < 0.6 * np.abs(draws - mean).mean()


def test_layer_norm():
    rows = np.random.default_rng(0).normal(3, 2, (5, 8)).astype(np.float32)
    want = (rows - rows.mean(axis=1, keepdims=True)) / np.sqrt(rows.var(axis=1, keepdims=True) + 1e-5)
    np.testing.assert_allclose(LayerNorm(8)(jnp.asarray(rows)), want, rtol=1e-4, atol=1e-5)


DISTINCT = {
    (method.fit, method.decoder): method
    for method in TABLE
    if method.fit and not method.fit.closed_form and not method.for_one_only
}


@pytest.mark.parametrize(
    "method", [long(row) if "vib" in row.name else row for row in DISTINCT.values()], ids=lambda method: method.name
)
def test_must_learn_credit_among_agents_from_the_mean_return(method):
    """Every agent's reward is the first feature. Only the return of all of them is known."""
    settings = CreditSettings(hidden=(16,), learning_rate=3e-3)
    attends = method.decoder in (Decoder.AREL, Decoder.STAS)
    episodes, updates = 64, 20 if attends else 300
    rows = np.random.default_rng(0).normal(size=(episodes, STEPS, AGENTS, 2)).astype(np.float32)
    reward = rows[..., 0]
    returns = jnp.asarray(reward.mean(axis=(1, 2)))
    state = decomposition.init(KEY, 2, method, settings, STEPS, AGENTS)
    state = decomposition.observe_steps(state, jnp.asarray(rows))
    state = decomposition.observe_returns(state, returns, jnp.full(episodes, STEPS), jnp.ones(episodes, bool))
    drawn = STEPS if method.fit is Fit.ALL_STEPS else 3

    def one(state, key):
        order = jax.vmap(lambda key: jax.random.permutation(key, STEPS)[:drawn])(jax.random.split(key, episodes))
        seen = jnp.asarray(rows)[jnp.arange(episodes)[:, None], jnp.sort(order, axis=1)].reshape(-1, AGENTS, 2)
        episode, length = jnp.repeat(jnp.arange(episodes), drawn), jnp.full(episodes, STEPS)
        batch = Episodes(seen, episode, length, returns, jnp.ones(episodes))
        state, measured = descent.update(state, batch, key, method.fit, settings)
        return state, measured["credit/loss"]

    keys = jax.random.split(jax.random.key(0), updates)
    state, losses = jax.jit(lambda state: jax.lax.scan(one, state, keys))(state)
    assert float(losses[-5:].mean()) < float(losses[:5].mean())
    if method.decoder is Decoder.STEP:
        r_hat = decomposition.proxy_rewards(state, jnp.asarray(rows).reshape(-1, AGENTS, 2), settings)
        assert np.corrcoef(np.ravel(r_hat), reward.ravel())[0, 1] > 0.9
