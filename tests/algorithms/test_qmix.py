"""QMIX's update against the worked example, its padding and exploration, and the game that it solves and VDN does not."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.numpy_qmix import PINNED, SETTINGS, numpy_networks, numpy_sequences
from lare_rl.algorithms.batches import Sequences
from lare_rl.algorithms.qmix import QMIXSettings, qmix
from lare_rl.algorithms.qmix.qmix import QMIX
from lare_rl.nn.networks import init_adam

KEEP, COPY = jnp.array(False), jnp.array(True)
update = jax.jit(partial(qmix.update, settings=SETTINGS))


def worked_state() -> QMIX:
    online = numpy_networks(PINNED["online"])
    return QMIX(online, numpy_networks(PINNED["target"]), init_adam(online, SETTINGS.learning_rate))


def init_state(seed=0, monotonic=True) -> QMIX:
    settings = SETTINGS.model_copy(update={"monotonic": monotonic})
    return jax.jit(qmix.init, static_argnums=(1, 2, 3, 4, 5))(jax.random.key(seed), 2, 2, 3, 2, settings)


def equal(a, b) -> bool:
    return jax.tree.all(jax.tree.map(jnp.array_equal, a, b))


def assert_close(a, b, rtol=1e-5, atol=1e-6):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=rtol, atol=atol), a, b)


# The worked example.


@pytest.mark.parametrize("masked", [True, False])
def test_td_targets(masked):
    state, batch = worked_state(), numpy_sequences()
    if not masked:  # then another action is the greedy one
        batch = batch._replace(available=jnp.ones((2, 4, 2, 3), bool))
    got = qmix.td_targets(state.target, qmix.action_values(state.online.agent, batch), batch, SETTINGS)
    expected = np.asarray(PINNED["lambda_return"]) if masked else np.array([[np.nan] * 3, [1.093696, 2.502918, 1]])
    rows = slice(None) if masked else slice(1, None)
    np.testing.assert_allclose(got[rows], expected[rows], rtol=1e-5, atol=2e-6)


def test_loss_gradient():
    grad = jax.jit(jax.value_and_grad(qmix.loss, has_aux=True), static_argnums=3)
    loss, gradient = grad(worked_state().online, worked_state().target, numpy_sequences(), SETTINGS)
    assert float(loss[0]) == pytest.approx(PINNED["loss"], rel=1e-6)
    assert_close(gradient, numpy_networks(PINNED["grad"]), rtol=1e-4, atol=3e-6)


def test_update():
    after, metrics = update(worked_state(), numpy_sequences(), KEEP)
    mask = np.asarray(PINNED["mask"])
    assert float(metrics["critic/loss"]) == pytest.approx(PINNED["loss"], rel=1e-6)
    mean_target = (np.asarray(PINNED["lambda_return"]) * mask).sum() / mask.sum()
    assert float(metrics["critic/value"]) == pytest.approx(mean_target, rel=1e-5)
    loss_after, _ = jax.jit(qmix.loss, static_argnums=3)(after.online, after.target, numpy_sequences(), SETTINGS)
    assert float(loss_after) == pytest.approx(PINNED["loss_after"], rel=1e-6)


@pytest.mark.parametrize("max_grad_norm", [10.0, 0.5])
def test_update_clips_gradient(max_grad_norm):
    """Adam's first mean is a tenth of the gradient, whose norm is 7.5."""
    settings = SETTINGS.model_copy(update={"max_grad_norm": max_grad_norm})
    after, _ = jax.jit(partial(qmix.update, settings=settings))(worked_state(), numpy_sequences(), KEEP)
    mean = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(after.optimizer[0].mu)])
    assert 10 * np.linalg.norm(mean) == pytest.approx(min(PINNED["grad_norm"], max_grad_norm), rel=1e-5)


def test_update_copies_targets():
    start = worked_state()
    unchanged, copied = (update(start, numpy_sequences(), copy)[0] for copy in (KEEP, COPY))
    assert equal(unchanged.target, start.target)
    assert equal(unchanged.online, copied.online)
    assert equal(copied.target, copied.online)
    assert not equal(copied.online, start.online)
    assert equal(init_state().online, init_state().target)


# Targets.


@pytest.mark.parametrize(
    ("td_lambda", "value", "terminated", "expected"),
    [
        (0.0, [4.0, 5, 6, 7], [0.0, 0, 1], [1 + 0.99 * 5, 0.99 * 6, 2]),
        (1.0, [4.0, 5, 6, 7], [0.0, 0, 1], [1 + 0.99**2 * 2, 0.99 * 2, 2]),
        (0.6, [9.0, 0.5, 1, 4], [0.0, 0, 0], [3.53612656, 3.93624, 5.96]),  # bootstraps after the last step
    ],
)
def test_lambda_returns(td_lambda, value, terminated, expected):
    settings = SETTINGS.model_copy(update={"td_lambda": td_lambda})
    arrays = (jnp.array([row]) for row in ([1.0, 0, 2], terminated, [1.0, 1, 1], value))
    np.testing.assert_allclose(qmix.lambda_returns(*arrays, settings), [expected], rtol=1e-6)


# Padding.


def test_update_ignores_padding():
    batch = numpy_sequences()
    expected = update(worked_state(), batch, COPY)
    junk = batch._replace(
        observation=batch.observation.at[0, 3:].set(50.0),
        state=batch.state.at[0, 3:].set(-50.0),
        available=batch.available.at[0, 3:].set(True),
        action=batch.action.at[0, 2:].set(0.0),
        reward=batch.reward.at[0, 2:].set(100.0),
    )
    longer = jax.tree.map(lambda leaf: jnp.pad(leaf, ((0, 0), (0, 2), *((0, 0),) * (leaf.ndim - 2))), batch)
    assert_close(update(worked_state(), junk, COPY), expected)
    assert_close(update(worked_state(), longer, COPY), expected)
    after, metrics = update(worked_state(), jax.tree.map(jnp.zeros_like, batch), KEEP)
    assert equal(after.online, worked_state().online)
    assert {float(value) for value in metrics.values()} == {0.0}


# Acting.


def test_act_agrees_with_action_values():
    """Acting step by step with a memory gives the best actions by the values of the unrolled episode."""
    agent = jax.tree.map(lambda leaf: 5 * leaf, init_state().online.agent)  # large weights, so that past steps matter
    rng = np.random.default_rng(0)
    observation = jnp.asarray(rng.normal(size=(4, 6, 2, 2)), jnp.float32)
    available = jnp.asarray(rng.random((4, 6, 2, 3)) < 0.6).at[..., 0].set(True)
    memory, actions = qmix.init_memory((4, 2), 3, SETTINGS), []
    for step in range(5):
        action, memory = qmix.act(agent, memory, observation[:, step], available[:, step])
        actions.append(action)
    action, zeros = jnp.stack(actions, axis=1), jnp.zeros((4, 5))
    batch = Sequences(observation, jnp.zeros((4, 6, 2)), available, action, zeros, zeros, zeros + 1)
    np.testing.assert_array_equal(qmix.greedy_action(qmix.action_values(agent, batch), available)[:, :-1], action)
    np.testing.assert_array_equal(memory.last_action, action[:, -1])


@pytest.mark.parametrize("epsilon", [0.0, 0.5, 1.0])
def test_act_never_chooses_unavailable_actions(epsilon):
    rng = np.random.default_rng(1)
    available = jnp.asarray(rng.random((500, 2, 3)) < 0.4).at[..., 2].set(True)
    noise = jnp.asarray(rng.random((500, 2, 4)), jnp.float32).at[:100].set(0)  # the smallest possible noise
    observation = jnp.asarray(rng.normal(size=(500, 2, 2)), jnp.float32)
    memory = qmix.init_memory((500, 2), 3, SETTINGS)
    action, _ = qmix.act(init_state().online.agent, memory, observation, available, noise, epsilon)
    np.testing.assert_array_equal(action.sum(axis=-1), 1)
    assert bool((available | (action == 0)).all())


def test_act_explores_uniformly_and_independently():
    count, agent = 20_000, init_state().online.agent
    available = jnp.tile(jnp.array([[True, False, True], [True, True, True]]), (count, 1, 1))
    observation, memory = jnp.ones((count, 2, 2)), qmix.init_memory((count, 2), 3, SETTINGS)
    noise = jax.random.uniform(jax.random.key(0), (count, 2, 4))
    action, _ = qmix.act(agent, memory, observation, available, noise, 1.0)
    np.testing.assert_allclose(action.mean(axis=0), [[1 / 2, 0, 1 / 2], [1 / 3] * 3], atol=0.015)
    greedy, _ = qmix.act(agent, memory, observation, available)
    action, _ = qmix.act(agent, memory, observation, available, noise, 0.3)
    differs = np.asarray((action != greedy).any(axis=-1))
    np.testing.assert_allclose(differs.mean(axis=0), [0.3 / 2, 0.3 * 2 / 3], atol=0.015)
    assert differs.all(axis=1).mean() == pytest.approx(0.3 / 2 * 0.3 * 2 / 3, abs=0.01)


@pytest.mark.parametrize(("step", "expected"), [(0, 1.0), (50_000, 0.525), (100_000, 0.05), (1_000_000, 0.05)])
def test_epsilon_falls_linearly(step, expected):
    assert float(qmix.epsilon(step, QMIXSettings())) == pytest.approx(expected)


# Seeds, VDN, and the game.


@pytest.mark.parametrize("monotonic", [True, False])
def test_update_of_many_seeds(monotonic):
    """Under `vmap` each seed learns as if it were alone."""
    update = partial(qmix.update, settings=SETTINGS.model_copy(update={"monotonic": monotonic}))
    states = [init_state(seed, monotonic) for seed in range(3)]
    batches = [jax.tree.map(lambda leaf, r=r: jnp.roll(leaf, r, axis=0), numpy_sequences()) for r in range(3)]
    state, batch = (jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees) for trees in (states, batches))
    got = jax.jit(jax.vmap(update, (0, 0, None)))(state, batch, COPY)
    for seed in range(3):
        expected = jax.jit(update)(states[seed], batches[seed], COPY)
        assert_close(jax.tree.map(lambda leaf, s=seed: leaf[s], got), expected, atol=1e-5)


def test_vdn_sums_values():
    state, batch = init_state(monotonic=False), numpy_sequences()
    settings = SETTINGS.model_copy(update={"monotonic": False})
    value = qmix.action_values(state.online.agent, batch)
    q_total = jnp.sum(value[:, :-1] * batch.action, axis=(-2, -1))
    error = batch.mask * (q_total - qmix.td_targets(state.target, value, batch, settings)) ** 2
    _, metrics = jax.jit(qmix.update, static_argnums=3)(state, batch, KEEP, settings)
    assert float(metrics["critic/loss"]) == pytest.approx(float(error.sum() / 2 / 5), rel=1e-5)


REWARD = jnp.array([[[7.0, 7.0], [7.0, 7.0]], [[0.0, 1.0], [1.0, 8.0]]])
"""By the first agent's first action, and both agents' second actions."""
SEEDS, EPISODES, UPDATES = 4, 32, 400


def play_two_step_game(agent, settings, noise=None) -> Sequences:
    """Play the game of Rashid et al. (2018), in which both agents observe their room; uniformly random with noise."""
    count = 1 if noise is None else EPISODES
    available = jnp.ones((count, 3, 2, 2), bool)
    memory, room, rooms, actions = qmix.init_memory((count, 2), 2, settings), jnp.zeros(count, int), [], []
    for step in range(2):
        rooms.append(jax.nn.one_hot(room, 3))
        observation = jnp.repeat(rooms[-1][:, None], 2, axis=1)
        step_noise = None if noise is None else noise[step]
        action, memory = qmix.act(agent, memory, observation, available[:, step], step_noise, 1.0)
        actions.append(action)
        room = 1 + jnp.argmax(action[:, 0], axis=-1)
    state, action = jnp.stack([*rooms, jnp.zeros((count, 3))], axis=1), jnp.stack(actions, axis=1)
    first, second_1, second_2 = (jnp.argmax(a, axis=-1) for a in (action[:, 0, 0], action[:, 1, 0], action[:, 1, 1]))
    last = jnp.tile(jnp.array([0.0, 1.0]), (count, 1))
    return Sequences(
        observation=jnp.repeat(state[:, :, None], 2, axis=2),
        state=state,
        available=available,
        action=action,
        reward=jnp.stack([jnp.zeros(count), REWARD[first, second_1, second_2]], axis=1),
        terminated=last,
        mask=jnp.ones_like(last),
    )


@pytest.mark.parametrize(("monotonic", "return_"), [(True, 8.0), (False, 7.0)])
def test_two_step_game(monotonic, return_):
    """A sum cannot express that 8 needs both agents, and prefers the safe 7. The mixer can."""
    settings = QMIXSettings(
        hidden=16, embed=8, hypernet=16, learning_rate=5e-3, td_lambda=0.0, target_every=50, monotonic=monotonic
    )

    def train(key):
        def step(state, index):
            noise = jax.random.uniform(jax.random.fold_in(key, index), (2, EPISODES, 2, 3))
            batch = play_two_step_game(state.online.agent, settings, noise)
            return qmix.update(state, batch, (index + 1) % settings.target_every == 0, settings)[0], None

        state, _ = jax.lax.scan(step, qmix.init(key, 2, 3, 2, 3, settings), jnp.arange(UPDATES))
        return play_two_step_game(state.online.agent, settings).reward.sum()

    returns = jax.jit(jax.vmap(train))(jax.random.split(jax.random.key(0), SEEDS))
    np.testing.assert_array_equal(returns, return_)
