import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.numpy_qmix import PINNED, SETTINGS, numpy_networks, numpy_sequences
from helpers.numpy_twins import assert_close, equal
from lare_rl.algorithms.batches import Sequences
from lare_rl.algorithms.qmix import QMIXSettings, qmix
from lare_rl.algorithms.qmix.networks import Mixer, RecurrentNetwork, mix
from lare_rl.algorithms.qmix.qmix import QMIX
from lare_rl.nn.networks import init_adam

KEEP, COPY = jnp.array(False), jnp.array(True)
init = jax.jit(qmix.init, static_argnums=(1, 2, 3, 4, 5))
update, act = jax.jit(qmix.update, static_argnums=3), jax.jit(qmix.act)
action_values, td_targets = jax.jit(qmix.action_values), jax.jit(qmix.td_targets, static_argnums=3)


def worked_state() -> QMIX:
    online = numpy_networks(PINNED["online"])
    return QMIX(online, numpy_networks(PINNED["target"]), init_adam(online, SETTINGS.learning_rate))


@pytest.fixture(scope="module")
def untrained() -> QMIX:
    return init(jax.random.key(0), 2, 2, 3, 2, SETTINGS)


def test_mixer_is_monotonic():
    """Its slope is never negative, and depends on the state."""

    def slope(key, scale):
        mixer_key, value_key, state_key = jax.random.split(key, 3)
        mixer = jax.tree.map(lambda leaf: scale * leaf, Mixer(3, 5, 4, 6, key=mixer_key))
        value = jnp.tile(jax.random.normal(value_key, (3,)), (20, 1))
        return jax.grad(lambda value: mixer(value, jax.random.normal(state_key, (20, 5))).sum())(value)

    slopes = np.asarray(jax.jit(jax.vmap(slope))(jax.random.split(jax.random.key(0), 50), jnp.geomspace(0.1, 10, 50)))
    assert (slopes >= 0).all()
    assert not np.isclose(slopes[:, 0], slopes[:, 1], rtol=1e-3).all()
    np.testing.assert_allclose(mix(None, jnp.array([[1.0, -2.0, 4.0]]), jnp.zeros((1, 0))), [3.0])  # VDN has a sum


def test_td_targets_if_all_actions_are_available():
    """Then another action is the greedy one."""
    state, batch = worked_state(), numpy_sequences()._replace(available=jnp.ones((2, 4, 2, 3), bool))
    targets = td_targets(state.target, action_values(state.online.agent, batch), batch, SETTINGS)
    np.testing.assert_allclose(targets[1:], [[1.093696, 2.502918, 1]], rtol=1e-5, atol=2e-6)


def test_update():
    """Adam's first mean is a tenth of the gradient, whose norm is 7.5. Its first step does not depend on this norm."""
    settings = SETTINGS.model_copy(update={"max_grad_norm": 0.5})
    after, metrics = update(worked_state(), numpy_sequences(), KEEP, settings)
    factor = 0.1 * 0.5 / PINNED["grad_norm"]
    expected = jax.tree.map(lambda leaf: factor * leaf, numpy_networks(PINNED["grad"]))
    assert_close(after.optimizer[0].mu, expected, rtol=1e-4, atol=3e-7)
    mask = np.asarray(PINNED["mask"])
    assert float(metrics["critic/loss"]) == pytest.approx(PINNED["loss"], rel=1e-6)
    mean_target = (np.asarray(PINNED["lambda_return"]) * mask).sum() / mask.sum()
    assert float(metrics["critic/value"]) == pytest.approx(mean_target, rel=1e-5)
    _, metrics = update(after, numpy_sequences(), KEEP, settings)
    assert float(metrics["critic/loss"]) == pytest.approx(PINNED["loss_after"], rel=1e-6)


def test_update_copies_targets(untrained):
    start = worked_state()
    unchanged, copied = (update(start, numpy_sequences(), copy, SETTINGS)[0] for copy in (KEEP, COPY))
    assert equal(unchanged.target, start.target)
    assert equal(unchanged.online, copied.online)
    assert equal(copied.target, copied.online)
    assert not equal(copied.online, start.online)
    assert equal(untrained.online, untrained.target)


def test_lambda_returns():
    arrays = [jnp.array([row]) for row in ([1.0, 0, 2], [0.0, 0, 1], [1.0, 1, 1], [4.0, 5, 6, 7])]
    for td_lambda, expected in ((0.0, [1 + 0.99 * 5, 0.99 * 6, 2]), (1.0, [1 + 0.99**2 * 2, 0.99 * 2, 2])):
        settings = SETTINGS.model_copy(update={"td_lambda": td_lambda})
        np.testing.assert_allclose(qmix.lambda_returns(*arrays, settings), [expected], rtol=1e-6)


def test_update_ignores_padding():
    batch = numpy_sequences()
    expected = update(worked_state(), batch, COPY, SETTINGS)
    junk = batch._replace(
        observation=batch.observation.at[0, 3:].set(50.0),
        state=batch.state.at[0, 3:].set(-50.0),
        available=batch.available.at[0, 3:].set(True),
        action=batch.action.at[0, 2:].set(0.0),
        reward=batch.reward.at[0, 2:].set(100.0),
    )
    longer = jax.tree.map(lambda leaf: jnp.pad(leaf, ((0, 0), (0, 2), *((0, 0),) * (leaf.ndim - 2))), batch)
    assert_close(update(worked_state(), junk, COPY, SETTINGS), expected, 1e-5, 1e-6)
    assert_close(update(worked_state(), longer, COPY, SETTINGS), expected, 1e-5, 1e-6)
    after, metrics = update(worked_state(), jax.tree.map(jnp.zeros_like, batch), KEEP, SETTINGS)
    assert equal(after.online, worked_state().online)
    assert {float(value) for value in metrics.values()} == {0.0}


def test_initial_weights_are_those_of_pytorch():
    """They are uniform in ±1/sqrt(inputs), and all of the GRU in ±1/sqrt(width)."""
    network = RecurrentNetwork(25, 64, 9, key=jax.random.key(0))
    layers = (network.encoder, 25), (network.gru, 64), (network.head, 64)
    for layer, size in layers:
        for leaf in jax.tree.leaves(layer):
            largest = float(np.abs(leaf).max()) * size**0.5
            assert (0.75 if leaf.size < 64 else 0.9) < largest <= 1


def test_act_agrees_with_action_values(untrained):
    """Acting step by step with a memory gives the best actions by the values of the unrolled episode."""
    agent = jax.tree.map(lambda leaf: 5 * leaf, untrained.online.agent)  # large weights, so that past steps matter
    rng = np.random.default_rng(0)
    observation = jnp.asarray(rng.normal(size=(4, 6, 2, 2)), jnp.float32)
    available = jnp.asarray(rng.random((4, 6, 2, 3)) < 0.6).at[..., 0].set(True)
    memory, actions = qmix.init_memory((4, 2), 3, SETTINGS), []
    for step in range(5):
        action, memory = act(agent, memory, observation[:, step], available[:, step])
        actions.append(action)
    action, zeros = jnp.stack(actions, axis=1), jnp.zeros((4, 5))
    batch = Sequences(observation, jnp.zeros((4, 6, 2)), available, action, zeros, zeros, zeros + 1)
    np.testing.assert_array_equal(qmix.greedy_action(action_values(agent, batch), available)[:, :-1], action)
    np.testing.assert_array_equal(memory.last_action, action[:, -1])


def test_act_explores_uniformly_and_independently(untrained):
    """Actions that are not available are never chosen, not even with the smallest possible noise."""
    count, agent = 20_000, untrained.online.agent
    available = jnp.tile(jnp.array([[True, False, True], [True, True, True]]), (count, 1, 1))
    observation, memory = jnp.ones((count, 2, 2)), qmix.init_memory((count, 2), 3, SETTINGS)
    noise = jax.random.uniform(jax.random.key(0), (count, 2, 4)).at[:100].set(0)
    action, greedy, mixed = (
        np.asarray(act(agent, memory, observation, available, noise, epsilon)[0]) for epsilon in (1.0, 0.0, 0.3)
    )
    for actions in (action, greedy, mixed):
        np.testing.assert_array_equal(actions.sum(axis=-1), 1)
        assert (available | (actions == 0)).all()
    np.testing.assert_allclose(action.mean(axis=0), [[1 / 2, 0, 1 / 2], [1 / 3] * 3], atol=0.015)
    differs = (mixed != greedy).any(axis=-1)
    np.testing.assert_allclose(differs.mean(axis=0), [0.3 / 2, 0.3 * 2 / 3], atol=0.015)
    assert differs.all(axis=1).mean() == pytest.approx(0.3 / 2 * 0.3 * 2 / 3, abs=0.01)
    epsilons = [float(qmix.epsilon(step, QMIXSettings())) for step in (0, 50_000, 100_000, 1_000_000)]
    assert epsilons == pytest.approx([1.0, 0.525, 0.05, 0.05])


REWARD = np.array([[[7.0, 7.0], [7.0, 7.0]], [[0.0, 1.0], [1.0, 8.0]]])
"""By the first agent's first action, and both agents' second actions."""


def all_games() -> Sequences:
    """Return all episodes of the game of Rashid et al. (2018), in which both agents observe their room."""
    first, first_2, second_1, second_2 = np.array(list(np.ndindex(2, 2, 2, 2))).T
    rooms = np.eye(4)[np.stack([0 * first, 1 + first, 0 * first + 3], axis=1)][..., :3]
    action = np.eye(2)[np.stack([first, first_2, second_1, second_2], axis=1).reshape(16, 2, 2)]
    reward = np.stack([0 * first, REWARD[first, second_1, second_2]], axis=1)
    arrays = np.repeat(rooms[:, :, None], 2, axis=2), rooms, action, reward, np.tile([0, 1], (16, 1)), np.ones((16, 2))
    observation, state, action, reward, terminated, mask = (jnp.asarray(array, jnp.float32) for array in arrays)
    return Sequences(observation, state, jnp.ones((16, 3, 2, 2), bool), action, reward, terminated, mask)


@pytest.mark.parametrize(("monotonic", "return_"), [(True, 8.0), (False, 7.0)])
def test_two_step_game(monotonic, return_):
    """A sum cannot express that 8 needs both agents, and prefers the safe 7. The mixer can."""
    settings = QMIXSettings(hidden=16, embed=8, hypernet=16, learning_rate=5e-3, td_lambda=0.0, monotonic=monotonic)
    state, batch = init(jax.random.key(0), 2, 3, 2, 3, settings), all_games()
    copies = jnp.arange(400) % 50 == 49
    state = jax.lax.scan(lambda state, copy: (qmix.update(state, batch, copy, settings)[0], None), state, copies)[0]
    memory, room, actions = qmix.init_memory((2,), 2, settings), 0, []
    for _ in range(2):
        observation = jnp.tile(jnp.eye(3)[room], (2, 1))
        action, memory = act(qmix.get_actor(state), memory, observation, jnp.ones((2, 2), bool))
        actions.append(action.argmax(axis=-1))
        room = 1 + int(actions[0][0])
    assert REWARD[actions[0][0], actions[1][0], actions[1][1]] == return_
