"""PPO's update against NumPy, its invariances, and a toy that it must learn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.algorithms.batches import Rollout
from lare_rl.algorithms.ppo import PPOSettings, ppo
from lare_rl.nn.normalise import running_std, update_mean_std

SETTINGS = PPOSettings(hidden=(16,), minibatch_size=8, epochs=3)
ONE_STEP = PPOSettings(hidden=(16,), minibatch_size=24, epochs=1, learning_rate=0.05)
KEY, START = jax.random.key(1), jnp.array(1.0)
init, update = jax.jit(ppo.init, static_argnums=(1, 2, 3, 4)), jax.jit(ppo.update, static_argnums=4)


def init_state(settings=SETTINGS, discrete=True):
    return init(jax.random.key(0), 3, 2, discrete, settings)


def random_rollout(time=6, actors=4, discrete=True, done=None):
    rng = np.random.default_rng(0)
    observation = rng.normal(size=(time + 1, actors, 3))
    action = rng.normal(size=(time, actors, 2))
    if discrete:
        action = np.eye(2)[action.argmax(axis=-1)]
    done = np.zeros((time, actors)) if done is None else done
    reward = rng.normal(size=(time, actors))
    arrays = (observation[:-1], action, reward, observation[1:], done, done)
    return Rollout(*(jnp.asarray(array, jnp.float32) for array in arrays))


def done_at(*indices):
    done = np.zeros((6, 4))
    for index in indices:
        done[index] = 1
    return done


def assert_close(a, b, rtol=1e-4, atol=1e-5):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=rtol, atol=atol), a, b)


def test_advantages():
    rollout, rng = random_rollout(done=done_at((2, 1), (4, 2))), np.random.default_rng(1)
    v_tm1, v_t = rng.normal(size=(2, 6, 4)).astype(np.float32)
    got = ppo.advantages(rollout, jnp.asarray(v_tm1), jnp.asarray(v_t), SETTINGS)
    reward, done = np.asarray(rollout.reward), np.asarray(rollout.done)
    for actor, t in np.ndindex(4, 6):
        expected, weight = 0.0, 1.0
        for k in range(t, 6):
            expected += weight * (reward[k, actor] + 0.99 * (1 - done[k, actor]) * v_t[k, actor] - v_tm1[k, actor])
            weight *= 0.99 * 0.95 * (1 - done[k, actor])
        assert float(got[t, actor]) == pytest.approx(expected, rel=1e-4, abs=1e-5)


def test_advantages_bootstrap_after_truncation():
    rollout = random_rollout(1, 2, done=np.ones((1, 2)))._replace(terminated=jnp.array([[0.0, 1.0]]))
    got = ppo.advantages(rollout, jnp.zeros((1, 2)), jnp.full((1, 2), 10.0), SETTINGS)
    np.testing.assert_allclose(got - rollout.reward, [[9.9, 0.0]], rtol=1e-5, atol=1e-6)


def test_prepare_batch():
    """Values are in units of the reward; targets and the critic's outputs in standard deviations of the return."""
    state, rollout = init_state(), random_rollout()
    state = state._replace(returns=update_mean_std(state.returns, jnp.array([[3.0], [11.0]])))
    output = np.asarray(state.params.critic(rollout.observation))[..., 0]
    value = np.asarray(ppo.values(state, rollout.observation))
    np.testing.assert_allclose(value, 7 + 4 * output, rtol=1e-5)
    batch, returns, explained_variance = ppo.prepare_batch(state, rollout, SETTINGS)
    advantage = ppo.advantages(rollout, jnp.asarray(value), ppo.values(state, rollout.next_observation), SETTINGS)
    return_ = np.asarray(advantage) + value
    assert float(returns.mean[0]) == pytest.approx((3 + 11 + return_.sum()) / 26, rel=1e-4)
    target = (return_.ravel() - returns.mean) / running_std(returns)
    np.testing.assert_allclose(batch.target, target, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(batch.value, output.ravel(), rtol=1e-5)
    assert float(explained_variance) == pytest.approx(1 - np.var(return_ - value) / np.var(return_), rel=1e-3)
    normalised = np.asarray(advantage - advantage.mean()) / np.asarray(advantage).std()
    np.testing.assert_allclose(batch.advantage, normalised.ravel(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("ratio", "advantage", "expected"),
    [(1.0, 2.0, 2.0), (1.5, 2.0, 2.4), (0.5, 2.0, 1.0), (1.5, -2.0, -3.0), (0.5, -2.0, -1.6)],
)
def test_policy_objective_is_pessimistic(ratio, advantage, expected):
    got = ppo.policy_objective(jnp.array([ratio]), jnp.array([advantage]), 0.2)
    assert float(got) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    ("value", "old_value", "target", "expected"),
    [
        (1.0, 1.0, 3.0, 2.0),  # half the square
        (2.0, 0.0, 3.0, 3.125),  # clipped to 0.5, so 2.5 away: the larger of the two
        (30.0, 30.0, 0.0, 250.0),  # linear beyond 10
    ],
)
def test_value_loss_is_clipped_and_huber(value, old_value, target, expected):
    got = ppo.value_loss(jnp.array([value]), jnp.array([old_value]), jnp.array([target]), SETTINGS)
    assert float(got) == pytest.approx(expected, rel=1e-5)


def test_minibatch_indices_cover_each_epoch():
    indices = np.asarray(ppo.minibatch_indices(KEY, 24, SETTINGS))
    assert indices.shape == (9, 8)
    np.testing.assert_array_equal(np.sort(indices.reshape(3, 24)), np.tile(np.arange(24), (3, 1)))
    assert ppo.minibatch_indices(KEY, 27, SETTINGS).shape == (9, 8)


def test_update_against_numpy():
    """One gradient step on a whole rollout, its gradient by differences in float64: loss, clipping and Adam."""
    settings = PPOSettings(
        hidden=(4,), minibatch_size=24, epochs=1, entropy_coef=0.3, value_coef=0.7, max_grad_norm=0.1, anneal=True
    )
    state, rollout = init_state(settings), random_rollout()
    batch = jax.tree.map(np.asarray, ppo.prepare_batch(state, rollout, settings)[0])

    def network(leaves, x):
        *hidden, last = zip(leaves[::2], leaves[1::2], strict=True)
        for weight, bias in hidden:
            x = np.tanh(x @ weight + bias)
        return x @ last[0] + last[1]

    def loss(leaves):
        logits = network(leaves[:4], batch.observation)
        log_pi = logits - np.log(np.exp(logits).sum(axis=1, keepdims=True))
        objective = np.exp((batch.action * log_pi).sum(axis=1) - batch.log_probability) * batch.advantage
        entropy = -(np.exp(log_pi) * log_pi).sum(axis=1)
        error = network(leaves[4:], batch.observation)[:, 0] - batch.target
        return -objective.mean() + 0.7 * 0.5 * (error**2).mean() - 0.3 * entropy.mean()

    leaves = [np.asarray(leaf, np.float64) for leaf in jax.tree.leaves(state.params)]
    gradient = [np.zeros_like(leaf) for leaf in leaves]
    for slope, leaf in zip(gradient, leaves, strict=True):
        for index in np.ndindex(leaf.shape):
            value, losses = leaf[index], []
            for change in (1e-5, -1e-5):
                leaf[index] = value + change
                losses.append(loss(leaves))
            leaf[index], slope[index] = value, (losses[0] - losses[1]) / 2e-5
    norm = np.sqrt(sum((slope**2).sum() for slope in gradient))
    assert norm > 0.1
    after, _ = update(state, rollout, KEY, jnp.array(0.5), settings)
    mu, nu = (jax.tree.leaves(getattr(after.optimizer[0], name)) for name in ("mu", "nu"))
    for slope, leaf, m, v, new in zip(gradient, leaves, mu, nu, jax.tree.leaves(after.params), strict=True):
        clipped = slope * 0.1 / norm
        np.testing.assert_allclose(m, 0.1 * clipped, rtol=1e-2, atol=1e-6)
        np.testing.assert_allclose(v, 0.001 * clipped**2, rtol=2e-2, atol=1e-9)
        step = 0.5 * settings.learning_rate * (m / 0.1) / (np.sqrt(v / 0.001) + 1e-8)
        np.testing.assert_allclose(new, leaf - step, rtol=1e-4, atol=1e-6)


def test_update_metrics_of_policy_change():
    """The KL estimate and the clipped fraction are 0 before the first step, and then measure that step."""
    state, rollout = init_state(ONE_STEP), random_rollout()
    batch = ppo.prepare_batch(state, rollout, ONE_STEP)[0]
    after, metrics = update(state, rollout, KEY, START, ONE_STEP)
    assert float(metrics["actor/approx_kl"]) == pytest.approx(0, abs=1e-6)
    assert float(metrics["actor/clip_fraction"]) == 0
    _, metrics = update(state, rollout, KEY, START, ONE_STEP.model_copy(update={"epochs": 2}))
    log_ratio = np.asarray(after.params.actor.log_probability(batch.observation, batch.action) - batch.log_probability)
    assert float(metrics["actor/approx_kl"]) == pytest.approx((np.exp(log_ratio) - 1 - log_ratio).mean() / 2, rel=1e-3)
    clip_fraction = (np.abs(np.exp(log_ratio) - 1) > 0.2).mean()
    assert 0 < clip_fraction < 1
    assert float(metrics["actor/clip_fraction"]) == pytest.approx(clip_fraction / 2)


def test_update_anneals_to_zero():
    settings = PPOSettings(hidden=(16,), minibatch_size=8, epochs=1, anneal=True)
    state = init_state(settings)
    after, _ = update(state, random_rollout(), KEY, jnp.array(0.0), settings)
    assert jax.tree.all(jax.tree.map(jnp.array_equal, after.params, state.params))


@pytest.mark.parametrize("discrete", [True, False])
def test_update_is_invariant_to_reward_scale(discrete):
    settings = PPOSettings(hidden=(16,), minibatch_size=24, epochs=2, gamma=1.0, gae_lambda=1.0)
    rollout, state = random_rollout(done=done_at(-1), discrete=discrete), init_state(settings, discrete)
    params = state.params._replace(critic=jax.tree.map(jnp.zeros_like, state.params.critic))
    actors = [
        update(state._replace(params=params), rollout._replace(reward=scale * rollout.reward), KEY, START, settings)[0]
        for scale in (1.0, 1e-3, 1e3)
    ]
    for other in actors[1:]:
        assert_close(actors[0].params.actor, other.params.actor, rtol=1e-3)


@pytest.mark.parametrize(("discrete", "normalise"), [(True, True), (True, False), (False, True)])
def test_update_ignores_masked_actors(discrete, normalise):
    rollout = random_rollout(done=done_at((3, 1), -1), discrete=discrete)
    settings = ONE_STEP.model_copy(
        update={"minibatch_size": 99, "epochs": 2, "learning_rate": 0.01, "entropy_coef": 0.1}
        | {"normalise_observations": normalise}
    )
    padded = jax.tree.map(lambda rows: jnp.concatenate([rows, jnp.full_like(rows[:, :2], 7)], axis=1), rollout)
    mask = jnp.concatenate([jnp.ones((6, 4)), jnp.zeros((6, 2))], axis=1)
    state = init_state(settings, discrete)
    expected, all_valid, masked = (
        update(state, case, KEY, START, settings)
        for case in (rollout, rollout._replace(mask=jnp.ones((6, 4))), padded._replace(mask=mask))
    )
    assert_close(all_valid, expected, rtol=2e-3)
    assert_close(masked, expected, rtol=2e-3)
    if normalise:
        assert float(masked[0].observations.n_rows) == 24


def test_prepare_batch_ignores_steps_after_an_agent_has_left():
    state, rollout = init_state(), random_rollout(done=done_at(2))
    short = jax.tree.map(lambda rows: rows[:3], rollout)
    spoilt = jax.tree.map(lambda rows: rows.at[3:].set(9.0), rollout)
    mask = (jnp.arange(6) < 3)[:, None] * jnp.ones((6, 4))
    masked, *masked_statistics = ppo.prepare_batch(state, spoilt._replace(mask=mask), SETTINGS)
    expected, *statistics = ppo.prepare_batch(state, short, SETTINGS)
    assert_close(masked.advantage[:12], expected.advantage)
    assert_close(masked.target[:12], expected.target)
    assert_close(masked_statistics, statistics)


def test_update_does_not_train_unavailable_choices():
    state, rollout = init_state(), random_rollout()
    only_choice = rollout._replace(available=rollout.action > 0)
    after, metrics = update(state, only_choice, KEY, START, SETTINGS)
    assert jax.tree.all(jax.tree.map(jnp.array_equal, after.params.actor, state.params.actor))
    assert float(metrics["actor/entropy"]) == 0


@pytest.mark.parametrize("discrete", [True, False])
def test_ppo_learns(discrete):
    """The reward is 1 if the choice is the sign of s_0; or it is -(a_0 - s_0)^2."""
    settings = PPOSettings(hidden=(32,), minibatch_size=64, epochs=4, gamma=0.0, learning_rate=3e-3, entropy_coef=0.0)
    state = init_state(settings, discrete)

    def compute_reward(observation, action):
        if discrete:
            return (action[..., 0] == (observation[..., 0] > 0)).astype(jnp.float32)
        return -((action[..., 0] - observation[..., 0]) ** 2)

    @jax.jit
    def iterate(state, key):
        observation_key, noise_key, update_key = jax.random.split(key, 3)
        observation = jax.random.uniform(observation_key, (1, 256, 3), minval=-1, maxval=1)
        noise = (jax.random.gumbel if discrete else jax.random.normal)(noise_key, (1, 256, 2))
        action = ppo.explore(ppo.get_actor(state), observation, None, noise)
        done = jnp.ones((1, 256))
        rollout = Rollout(observation, action, compute_reward(observation, action), observation, done, done)
        return update(state, rollout, update_key, START, settings)[0]

    for seed in range(80):
        state = iterate(state, jax.random.key(seed))
    observation = jax.random.uniform(jax.random.key(5), (1, 256, 3), minval=-1, maxval=1)
    reward = compute_reward(observation, ppo.act(ppo.get_actor(state), observation, None))
    assert float(reward.mean()) > (0.93 if discrete else -0.03)
