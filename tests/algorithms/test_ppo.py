import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.numpy_twins import assert_close
from lare_rl.algorithms.batches import Rollout
from lare_rl.algorithms.ppo import PPOSettings, ppo
from lare_rl.nn.normalise import empty_mean_std, running_std, update_mean_std

# One gradient step on all 24 steps of `random_rollout`.
SETTINGS = PPOSettings(hidden=(4,), minibatch_size=24, epochs=1, learning_rate=0.2, entropy_coef=0.3, value_coef=0.7)
SETTINGS = SETTINGS.model_copy(update={"max_grad_norm": 0.1, "anneal": True})
TWO_EPOCHS = SETTINGS.model_copy(update={"epochs": 2})
KEY, START = jax.random.key(1), jnp.array(1.0)
init, update = jax.jit(ppo.init, static_argnums=(1, 2, 3, 4)), jax.jit(ppo.update, static_argnums=4)
prepare_batch, advantages = jax.jit(ppo.prepare_batch, static_argnums=2), jax.jit(ppo.advantages, static_argnums=3)


def init_state(settings=SETTINGS, discrete=True):
    return init(jax.random.key(0), 3, 2, discrete, settings)


def random_rollout():
    """Return 6 steps of 4 actors. Actor 1 terminates early, and actor 2 is truncated."""
    rng, done = np.random.default_rng(0), np.zeros((6, 4))
    observation, action = rng.normal(size=(7, 4, 3)), np.eye(2)[rng.integers(2, size=(6, 4))]
    done[2, 1] = 1
    terminated = done.copy()
    done[4, 2] = 1
    arrays = (observation[:-1], action, rng.normal(size=(6, 4)), observation[1:], terminated, done)
    return Rollout(*(jnp.asarray(array, jnp.float32) for array in arrays))


def test_advantages():
    """They bootstrap after a truncation, and not after a termination; no advantage reaches back over the end of an episode."""
    rollout = random_rollout()
    value, next_value = np.random.default_rng(1).normal(size=(2, 6, 4)).astype(np.float32)
    got = advantages(rollout, jnp.asarray(value), jnp.asarray(next_value), SETTINGS)
    reward, terminated, done = (np.asarray(values) for values in (rollout.reward, rollout.terminated, rollout.done))
    for actor, t in np.ndindex(4, 6):
        expected, weight = 0.0, 1.0
        for k in range(t, 6):
            delta = reward[k, actor] + 0.99 * (1 - terminated[k, actor]) * next_value[k, actor] - value[k, actor]
            expected += weight * delta
            weight *= 0.99 * 0.95 * (1 - done[k, actor])
        assert float(got[t, actor]) == pytest.approx(expected, rel=1e-4, abs=1e-5)


def test_prepare_batch():
    """Values are in units of the reward; targets and the critic's outputs in standard deviations of the return."""
    state, rollout = init_state(), random_rollout()
    state = state._replace(return_rms=update_mean_std(state.return_rms, jnp.array([[3.0], [11.0]])))
    output = np.asarray(state.params.critic(rollout.observation))[..., 0]
    value = np.asarray(ppo.values(state, rollout.observation))
    np.testing.assert_allclose(value, 7 + 4 * output, rtol=1e-5)
    batch, returns, explained_variance = prepare_batch(state, rollout, SETTINGS)
    advantage = advantages(rollout, jnp.asarray(value), ppo.values(state, rollout.next_observation), SETTINGS)
    return_ = np.asarray(advantage) + value
    assert float(returns.mean[0]) == pytest.approx((3 + 11 + return_.sum()) / 26, rel=1e-4)
    target = (return_.ravel() - returns.mean) / running_std(returns)
    np.testing.assert_allclose(batch.target, target, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(batch.value, output.ravel(), rtol=1e-5)
    assert float(explained_variance) == pytest.approx(1 - np.var(return_ - value) / np.var(return_), rel=1e-3)
    normalised = np.asarray(advantage - advantage.mean()) / np.asarray(advantage).std()
    np.testing.assert_allclose(batch.advantage, normalised.ravel(), rtol=1e-4, atol=1e-5)


def test_clipped_objective_and_value_loss():
    for ratio, advantage, expected in (
        (1.0, 2.0, 2.0),
        (1.5, 2.0, 2.4),
        (0.5, 2.0, 1.0),
        (1.5, -2.0, -3.0),
        (0.5, -2.0, -1.6),
    ):
        got = ppo.policy_objective(jnp.array([ratio]), jnp.array([advantage]), 0.2)
        assert float(got) == pytest.approx(expected, rel=1e-5)
    for *values, expected in (
        (1.0, 1.0, 3.0, 2.0),  # half the square
        (2.0, 0.0, 3.0, 3.125),  # clipped to 0.5, so 2.5 away: the larger of the two
        (30.0, 30.0, 0.0, 250.0),  # linear beyond 10
    ):
        got = ppo.value_loss(*(jnp.array([value]) for value in values), SETTINGS)
        assert float(got) == pytest.approx(expected, rel=1e-5)


def test_minibatch_indices_cover_each_epoch():
    settings = PPOSettings(minibatch_size=8, epochs=3)
    indices = np.asarray(ppo.minibatch_indices(KEY, 24, settings))
    assert indices.shape == (9, 8)
    np.testing.assert_array_equal(np.sort(indices.reshape(3, 24)), np.tile(np.arange(24), (3, 1)))
    assert ppo.minibatch_indices(KEY, 27, settings).shape == (9, 8)
    assert ppo.minibatch_indices(KEY, 5, settings).shape == (3, 5)


def test_update_against_numpy():
    """One gradient step on a whole rollout, its gradient by differences in float64: loss, clipping, Adam and annealing."""
    state, rollout = init_state(), random_rollout()
    batch = jax.tree.map(np.asarray, prepare_batch(state, rollout, SETTINGS)[0])

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
    after, _ = update(state, rollout, KEY, jnp.array(0.5), SETTINGS)
    mu, nu = (jax.tree.leaves(getattr(after.optimizer[0], name)) for name in ("mu", "nu"))
    for slope, leaf, m, v, new in zip(gradient, leaves, mu, nu, jax.tree.leaves(after.params), strict=True):
        clipped = slope * 0.1 / norm
        np.testing.assert_allclose(m, 0.1 * clipped, rtol=1e-2, atol=1e-6)
        np.testing.assert_allclose(v, 0.001 * clipped**2, rtol=2e-2, atol=1e-9)
        step = 0.5 * SETTINGS.learning_rate * (m / 0.1) / (np.sqrt(v / 0.001) + 1e-8)
        np.testing.assert_allclose(new, leaf - step, rtol=1e-4, atol=1e-6)
    end, _ = update(state, rollout, KEY, jnp.array(0.0), SETTINGS)
    assert jax.tree.all(jax.tree.map(jnp.array_equal, end.params, state.params))


def test_update_metrics_of_policy_change():
    """The KL estimate and the clipped fraction are 0 before the first step, and then measure that step."""
    state, rollout = init_state(), random_rollout()
    batch = prepare_batch(state, rollout, SETTINGS)[0]
    after, metrics = update(state, rollout, KEY, START, SETTINGS)
    assert float(metrics["actor/approx_kl"]) == pytest.approx(0, abs=1e-6)
    assert float(metrics["actor/clip_fraction"]) == 0
    _, metrics = update(state, rollout, KEY, START, TWO_EPOCHS)
    log_ratio = np.asarray(after.params.actor.log_probability(batch.observation, batch.action) - batch.log_probability)
    assert float(metrics["actor/approx_kl"]) == pytest.approx((np.exp(log_ratio) - 1 - log_ratio).mean() / 2, rel=1e-3)
    clip_fraction = (np.abs(np.exp(log_ratio) - 1) > 0.2).mean()
    assert 0 < clip_fraction < 1
    assert float(metrics["actor/clip_fraction"]) == pytest.approx(clip_fraction / 2)


def test_update_ignores_masked_actors():
    settings = TWO_EPOCHS.model_copy(update={"minibatch_size": 99, "normalise_observations": True})
    rollout, state = random_rollout(), init_state()._replace(observation_rms=empty_mean_std(3))
    rollout = rollout._replace(available=jnp.ones((6, 4, 2), bool).at[0].set(rollout.action[0] > 0))
    padded = jax.tree.map(lambda rows: jnp.concatenate([rows, jnp.full_like(rows[:, :2], 7)], axis=1), rollout)
    mask = jnp.concatenate([jnp.ones((6, 4)), jnp.zeros((6, 2))], axis=1)
    expected, masked = (update(state, case, KEY, START, settings) for case in (rollout, padded._replace(mask=mask)))
    assert_close(masked, expected, rtol=2e-3)
    assert float(masked[0].observation_rms.n_rows) == 24

    # Where there is no choice, there is nothing to train.
    after, metrics = update(state, rollout._replace(available=rollout.action > 0), KEY, START, settings)
    assert jax.tree.all(jax.tree.map(jnp.array_equal, after.params.actor, state.params.actor))
    assert float(metrics["actor/entropy"]) == 0


@pytest.mark.parametrize("discrete", [True, False])
def test_ppo_learns(discrete):
    """The reward is 1 if the choice is the sign of s_0; or it is -(a_0 - s_0)^2."""
    settings = PPOSettings(
        hidden=(32,), minibatch_size=64, epochs=4, gamma=0.0, learning_rate=3e-3, entropy_coef=0.0, anneal=False
    )

    def compute_reward(observation, action):
        if discrete:
            return (action[..., 0] == (observation[..., 0] > 0)).astype(jnp.float32)
        return -((action[..., 0] - observation[..., 0]) ** 2)

    def iterate(state, key):
        observation_key, noise_key, update_key = jax.random.split(key, 3)
        observation = jax.random.uniform(observation_key, (1, 256, 3), minval=-1, maxval=1)
        noise = (jax.random.gumbel if discrete else jax.random.normal)(noise_key, (1, 256, 2))
        action = ppo.explore(ppo.get_actor(state), observation, None, noise)
        done = jnp.ones((1, 256))
        rollout = Rollout(observation, action, compute_reward(observation, action), observation, done, done)
        return ppo.update(state, rollout, update_key, START, settings)[0], None

    @jax.jit
    def train(state):
        state, _ = jax.lax.scan(iterate, state, jax.random.split(KEY, 80))
        observation = jax.random.uniform(jax.random.key(5), (1, 256, 3), minval=-1, maxval=1)
        return compute_reward(observation, ppo.act(ppo.get_actor(state), observation, None)).mean()

    assert float(train(init_state(settings, discrete))) > (0.93 if discrete else -0.03)
