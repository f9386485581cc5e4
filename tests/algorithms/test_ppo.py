"""PPO's update against plain NumPy, its rules one by one, and a toy that it must learn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.algorithms import ppo
from lare_rl.algorithms.ppo import Rollout
from lare_rl.algorithms.settings import PPOSettings
from lare_rl.nn.normalise import deviation, observe

SETTINGS = PPOSettings(hidden=(16,), minibatch_size=8, epochs=3)
init, update = jax.jit(ppo.init, static_argnums=(1, 2, 3, 4)), jax.jit(ppo.update, static_argnums=4)


def state_of(discrete=True, settings=SETTINGS):
    return init(jax.random.key(0), 3, 2, discrete, settings)


def rollout_of(time=6, lanes=4, discrete=True, seed=0, ended=None):
    rng = np.random.default_rng(seed)
    observation = rng.normal(size=(time + 1, lanes, 3)).astype(np.float32)
    action = rng.normal(size=(time, lanes, 2)).astype(np.float32)
    if discrete:
        action = np.eye(2, dtype=np.float32)[action.argmax(axis=-1)]
    ended = np.zeros((time, lanes), np.float32) if ended is None else ended
    reward = rng.normal(size=(time, lanes)).astype(np.float32)
    return Rollout(*map(jnp.asarray, (observation[:-1], action, reward, observation[1:], 1 - ended, ended)))


def test_advantages_against_a_slow_sum():
    ended = np.zeros((6, 4), np.float32)
    ended[2, 1] = ended[4, 2] = 1
    rollout, rng = rollout_of(ended=ended), np.random.default_rng(1)
    value, following = rng.normal(size=(2, 6, 4)).astype(np.float32)
    got = ppo.advantages(rollout, jnp.asarray(value), jnp.asarray(following), SETTINGS)
    for lane in range(4):
        for t in range(6):
            want, weight = 0.0, 1.0
            for later in range(t, 6):
                goes_on = float(rollout.continues[later, lane])
                delta = rollout.reward[later, lane] + 0.99 * goes_on * following[later, lane] - value[later, lane]
                want += weight * float(delta)
                weight *= 0.99 * 0.95
                if ended[later, lane]:
                    break
            assert float(got[t, lane]) == pytest.approx(want, rel=1e-4, abs=1e-5)


def test_out_of_time_bootstraps_and_a_termination_does_not():
    """Both end the trace; only the termination takes the value of what follows away."""
    ended = np.ones((1, 2), np.float32)
    rollout = rollout_of(1, 2, ended=ended)._replace(continues=jnp.array([[1.0, 0.0]]))
    got = ppo.advantages(rollout, jnp.zeros((1, 2)), jnp.full((1, 2), 10.0), SETTINGS)
    np.testing.assert_allclose(got - rollout.reward, [[9.9, 0.0]], rtol=1e-5, atol=1e-6)


def test_values_are_in_units_of_the_reward_and_targets_in_deviations_of_the_return():
    state, rollout = state_of(), rollout_of()
    state = state._replace(returns=observe(state.returns, jnp.array([[3.0], [11.0]])))
    said = np.asarray(state.params.critic(rollout.observation))[..., 0]
    value = np.asarray(ppo.values(state, rollout.observation))
    np.testing.assert_allclose(value, 7 + 4 * said, rtol=1e-5)
    batch, returns, explained = ppo.prepare(state, rollout, SETTINGS)
    advantage = ppo.advantages(rollout, jnp.asarray(value), ppo.values(state, rollout.next_observation), SETTINGS)
    want = np.asarray(advantage) + value
    np.testing.assert_allclose(
        batch.target * float(deviation(returns)[0]) + float(returns.mean[0]), want.ravel(), rtol=1e-4
    )
    assert float(returns.mean[0]) == pytest.approx((3 + 11 + want.sum()) / 26, rel=1e-4)
    np.testing.assert_allclose(batch.value, said.ravel(), rtol=1e-5)
    assert float(explained) == pytest.approx(1 - np.var(want - value) / np.var(want), rel=1e-3)
    centred = np.asarray(advantage - advantage.mean()) / np.asarray(advantage).std()
    np.testing.assert_allclose(batch.advantage, centred.ravel(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("ratio", "advantage", "want"),
    [(1.0, 2.0, 2.0), (1.5, 2.0, 2.4), (0.5, 2.0, 1.0), (1.5, -2.0, -3.0), (0.5, -2.0, -1.6)],
)
def test_policy_objective_is_pessimistic(ratio, advantage, want):
    got = ppo.policy_objective(jnp.array([ratio]), jnp.array([advantage]), 0.2)
    assert float(got) == pytest.approx(want, rel=1e-5)


@pytest.mark.parametrize(
    ("value", "old", "target", "want"),
    [
        (1.0, 1.0, 3.0, 2.0),  # half the square
        (2.0, 0.0, 3.0, 3.125),  # kept at 0.5, so 2.5 away: the worse of the two
        (30.0, 30.0, 0.0, 250.0),  # linear beyond 10
    ],
)
def test_value_loss_is_clipped_and_huber(value, old, target, want):
    got = ppo.value_loss(jnp.array([value]), jnp.array([old]), jnp.array([target]), SETTINGS)
    assert float(got) == pytest.approx(want, rel=1e-5)


def test_every_epoch_reads_every_step_once():
    order = np.asarray(ppo.minibatches(jax.random.key(0), 24, SETTINGS))
    assert order.shape == (9, 8)
    for epoch in order.reshape(3, 24):
        assert sorted(epoch) == list(range(24))


@pytest.mark.parametrize("discrete", [True, False])
def test_rewards_of_any_scale_and_offset_train_alike(discrete):
    """Undiscounted episodes of one length: an offset is the same for all, a scale leaves the advantages as they are."""
    ended = np.zeros((6, 4), np.float32)
    ended[-1] = 1
    settings = PPOSettings(hidden=(16,), minibatch_size=24, epochs=2, gamma=1.0, gae_lambda=1.0)
    rollout = rollout_of(ended=ended, discrete=discrete)._replace(continues=jnp.asarray(1 - ended))
    state = state_of(discrete, settings)
    quiet = state._replace(params=state.params._replace(critic=jax.tree.map(jnp.zeros_like, state.params.critic)))
    actors = [
        update(quiet, rollout._replace(reward=scale * rollout.reward), jax.random.key(1), jnp.array(1.0), settings)[
            0
        ].params.actor
        for scale in (1.0, 1e-3, 1e3)
    ]
    for other in actors[1:]:
        for a, b in zip(jax.tree.leaves(actors[0]), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5)


def test_an_update_against_plain_numpy():
    """One gradient step on a whole rollout, its gradient taken by differences in float64: loss, cut and Adam."""
    settings = PPOSettings(
        hidden=(4,), minibatch_size=24, epochs=1, entropy_coef=0.3, value_coef=0.7, max_grad_norm=0.1, anneal=True
    )
    state, rollout = state_of(settings=settings), rollout_of()
    rows = jax.tree.map(np.asarray, ppo.prepare(state, rollout, settings)[0])

    def network(leaves, x):
        *hidden, last = zip(leaves[::2], leaves[1::2], strict=True)
        for weight, bias in hidden:
            x = np.tanh(x @ weight + bias)
        return x @ last[0] + last[1]

    def loss(leaves):
        out = network(leaves[:4], rows.observation)
        log = out - np.log(np.exp(out).sum(axis=1, keepdims=True))
        gain = (np.exp((rows.action * log).sum(axis=1) - rows.log_probability) * rows.advantage).mean()
        entropy = -(np.exp(log) * log).sum(axis=1).mean()
        missed = 0.5 * (network(leaves[4:], rows.observation)[:, 0] - rows.target) ** 2
        return -gain + 0.7 * missed.mean() - 0.3 * entropy

    old = [np.asarray(leaf, np.float64) for leaf in jax.tree.leaves(state.params)]
    gradient = [np.zeros_like(leaf) for leaf in old]
    for slope, leaf in zip(gradient, old, strict=True):
        for place in np.ndindex(leaf.shape):
            kept, ends = leaf[place], []
            for change in (1e-5, -1e-5):
                leaf[place] = kept + change
                ends.append(loss(old))
            leaf[place], slope[place] = kept, (ends[0] - ends[1]) / 2e-5
    norm = np.sqrt(sum((slope**2).sum() for slope in gradient))
    assert norm > 0.1
    after, _ = update(state, rollout, jax.random.key(1), jnp.array(0.5), settings)
    mean, square = (jax.tree.leaves(getattr(after.optimizer[0], name)) for name in ("mu", "nu"))
    new = jax.tree.leaves(after.params)
    for slope, leaf, m, v, moved in zip(gradient, old, mean, square, new, strict=True):
        cut = slope * 0.1 / norm
        np.testing.assert_allclose(m, 0.1 * cut, rtol=1e-2, atol=1e-6)
        np.testing.assert_allclose(v, 0.001 * cut**2, rtol=2e-2, atol=1e-9)
        step = 0.5 * settings.learning_rate * (m / 0.1) / (np.sqrt(v / 0.001) + 1e-8)
        np.testing.assert_allclose(moved, leaf - step, rtol=1e-4, atol=1e-6)


def test_how_far_an_update_moves_the_policy_is_measured():
    """Schulman's estimate of the divergence, and the share of steps beyond the clip: nothing at first, then what the step did."""
    settings = PPOSettings(hidden=(16,), minibatch_size=24, epochs=1, learning_rate=0.05)
    state, rollout = state_of(settings=settings), rollout_of()
    batch, left = ppo.prepare(state, rollout, settings)[0], jnp.array(1.0)
    after, first = update(state, rollout, jax.random.key(1), left, settings)
    assert float(first["actor/approx_kl"]) == pytest.approx(0, abs=1e-6)
    assert float(first["actor/clip_fraction"]) == 0
    twice = settings.model_copy(update={"epochs": 2})
    _, both = update(state, rollout, jax.random.key(1), left, twice)
    log = np.asarray(after.params.actor.log_probability(batch.observation, batch.action) - batch.log_probability)
    assert float(both["actor/approx_kl"]) == pytest.approx((np.exp(log) - 1 - log).mean() / 2, rel=1e-3)
    beyond = (np.abs(np.exp(log) - 1) > 0.2).mean()
    assert 0 < beyond < 1
    assert float(both["actor/clip_fraction"]) == pytest.approx(beyond / 2)


def test_annealing_ends_at_rest():
    settings = PPOSettings(hidden=(16,), minibatch_size=8, epochs=1, anneal=True)
    state = state_of(settings=settings)
    after, _ = update(state, rollout_of(), jax.random.key(1), jnp.array(0.0), settings)
    assert jax.tree.all(jax.tree.map(jnp.array_equal, after.params, state.params))
    after, _ = update(state, rollout_of(), jax.random.key(1), jnp.array(1.0), settings)
    assert not jax.tree.all(jax.tree.map(jnp.array_equal, after.params, state.params))


@pytest.mark.parametrize("discrete", [True, False])
def test_must_learn_to_follow(discrete):
    """r = 1 where the choice is the sign of s_0; or -(a_0 - s_0)^2. The policy must find out by trying."""
    settings = PPOSettings(hidden=(32,), minibatch_size=64, epochs=4, gamma=0.0, learning_rate=3e-3, entropy_coef=0.0)
    state = state_of(discrete, settings)

    @jax.jit
    def turn(state, key):
        keys = jax.random.split(key, 3)
        observation = jax.random.uniform(keys[0], (1, 256, 3), minval=-1, maxval=1)
        draw = jax.random.gumbel if discrete else jax.random.normal
        action = state.params.actor.sample(observation, draw(keys[1], (1, 256, 2)))
        reward = reward_of(observation, action)
        ends = jnp.ones((1, 256))
        rollout = Rollout(observation, action, reward, observation, 1 - ends, ends)
        return update(state, rollout, keys[2], jnp.array(1.0), settings)[0]

    def reward_of(observation, action):
        if discrete:
            return (action[..., 0] == (observation[..., 0] > 0)).astype(jnp.float32)
        return -((action[..., 0] - observation[..., 0]) ** 2)

    for number in range(80):
        state = turn(state, jax.random.key(number))
    observation = jax.random.uniform(jax.random.key(5), (1, 256, 3), minval=-1, maxval=1)
    learned = float(jnp.mean(reward_of(observation, state.params.actor.mode(observation))))
    assert learned > (0.93 if discrete else -0.03)


def test_values_may_move_from_what_the_critic_said():
    """The anchor of the value clip is the critic's own output, whatever unit the newest returns give it."""
    settings = PPOSettings(hidden=(8,))
    state = init(jax.random.key(0), 3, 2, False, settings)
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(2, 6, 4, 3)).astype(np.float32)
    action, reward = rng.normal(size=(6, 4, 2)).astype(np.float32), 100 + rng.normal(size=(6, 4)).astype(np.float32)
    rollout = ppo.Rollout(*map(jnp.asarray, (rows[0], action, reward, rows[1], np.ones((6, 4)), np.zeros((6, 4)))))
    batch, returns, _ = ppo.prepare(state, rollout, settings)
    np.testing.assert_allclose(batch.value, state.params.critic(rollout.observation.reshape(-1, 3))[:, 0], rtol=1e-5)
    assert float(returns.mean[0]) > 50
    np.testing.assert_allclose([batch.target.mean(), batch.target.std()], [0, 1], atol=1e-2)


def padded(rollout):
    """The same with two more lanes, of agents that are not there: what they hold is nonsense."""

    def wider(rows, more):
        return jnp.concatenate([rows, jnp.full((len(rows), more, *rows.shape[2:]), 7, rows.dtype)], axis=1)

    time, lanes = rollout.reward.shape
    mask = jnp.concatenate([jnp.ones((time, lanes)), jnp.zeros((time, 2))], axis=1)
    return jax.tree.map(lambda rows: wider(rows, 2), rollout._replace(mask=None, available=None))._replace(mask=mask)


@pytest.mark.parametrize("discrete", [True, False])
@pytest.mark.parametrize("normalise", [True, False])
def test_agents_that_are_not_there_change_nothing(discrete, normalise):
    """One gradient step on all lanes at once: with padding, and with no more than those who are there."""
    ended = np.zeros((6, 4), np.float32)
    ended[3, 1] = ended[-1] = 1
    rollout = rollout_of(ended=ended, discrete=discrete)
    settings = PPOSettings(
        hidden=(16,),
        minibatch_size=99,
        epochs=2,
        entropy_coef=0.1,
        normalise_observations=normalise,
        learning_rate=0.01,
    )
    state = state_of(discrete, settings)
    with_all = jnp.ones((6, 4))
    found = [
        update(state, given, jax.random.key(1), jnp.array(1.0), settings)
        for given in (rollout, rollout._replace(mask=with_all), padded(rollout))
    ]
    for other in found[1:]:
        for a, b in zip(jax.tree.leaves(found[0]), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(a, b, rtol=2e-3, atol=1e-5)


def test_what_follows_an_agents_last_step_does_not_reach_back():
    """Steps behind it are masked, whatever stands there; the same lane cut off has the same advantages."""
    ended, rollout = np.zeros((6, 4), np.float32), rollout_of()
    ended[2] = 1
    left = rollout._replace(ended=jnp.asarray(ended), continues=jnp.asarray(1 - ended))
    mask = (jnp.arange(6) < 3)[:, None] * jnp.ones((6, 4))
    spoilt = jax.tree.map(lambda rows: rows.at[3:].set(9.0), left)
    short = jax.tree.map(lambda rows: rows[:3], left)
    state = state_of()
    one, other = (ppo.prepare(state, given, SETTINGS) for given in (spoilt._replace(mask=mask), short))
    np.testing.assert_allclose(one[0].advantage.reshape(6, 4)[:3].ravel(), other[0].advantage, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(one[0].target.reshape(6, 4)[:3].ravel(), other[0].target, rtol=1e-4, atol=1e-5)
    for a, b in zip(jax.tree.leaves(one[1:]), jax.tree.leaves(other[1:]), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4)


def test_what_an_unavailable_choice_is_worth_teaches_nothing():
    """The gradient does not know of logits that were not there."""
    state, rollout = init(jax.random.key(0), 3, 2, True, SETTINGS), rollout_of()
    only = rollout.action > 0
    after, measured = update(state, rollout._replace(available=only), jax.random.key(1), jnp.array(1.0), SETTINGS)
    assert jax.tree.all(jax.tree.map(jnp.array_equal, after.params.actor, state.params.actor))
    assert float(measured["actor/entropy"]) == 0
