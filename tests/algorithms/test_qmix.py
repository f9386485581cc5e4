"""QMIX's update against the worked example, its rules one by one, and the game that it solves and VDN does not."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.worked_qmix import PINNED, SETTINGS, networks, sequences
from lare_rl.algorithms import qmix
from lare_rl.algorithms.qmix import QMIX, Sequences
from lare_rl.algorithms.settings import QMIXSettings
from lare_rl.algorithms.table import VDN
from lare_rl.nn.networks import start_adam

STAY, MOVE = jnp.array(False), jnp.array(True)


def worked() -> QMIX:
    online = networks(PINNED["online"])
    return QMIX(online, networks(PINNED["target"]), start_adam(online, SETTINGS.learning_rate))


def small(seed=0, monotonic=True) -> QMIX:
    settings = SETTINGS.model_copy(update={"monotonic": monotonic})
    return jax.jit(qmix.init, static_argnums=(1, 2, 3, 4, 5))(jax.random.key(seed), 2, 2, 3, 2, settings)


def same(a, b) -> bool:
    return jax.tree.all(jax.tree.map(jnp.array_equal, a, b))


def close(a, b, rtol=1e-5, atol=1e-6):
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(one, other, rtol=rtol, atol=atol)


update = jax.jit(partial(qmix.update, settings=SETTINGS))


def wanted(state, batch):
    return qmix.targets(state.target, qmix.action_values(state.online.agent, batch), batch, SETTINGS)


# The worked example.


def test_targets():
    np.testing.assert_allclose(wanted(worked(), sequences()), PINNED["lambda_return"], rtol=1e-5, atol=2e-6)


def test_unavailable_actions_are_not_what_would_be_done():
    """With the masks forgotten the targets are others."""
    forgotten = sequences()._replace(available=jnp.ones((2, 4, 2, 3), bool))
    np.testing.assert_allclose(wanted(worked(), forgotten)[1], [1.093696, 2.502918, 1], rtol=1e-5)


def test_loss_and_gradient():
    loss, gradient = jax.jit(jax.value_and_grad(qmix.loss, has_aux=True), static_argnums=3)(
        worked().online, worked().target, sequences(), SETTINGS
    )
    assert float(loss[0]) == pytest.approx(PINNED["loss"], rel=1e-6)
    close(gradient, networks(PINNED["grad"]), rtol=1e-4, atol=3e-6)


def test_an_update():
    after, metrics = update(worked(), sequences(), STAY)
    mask = np.asarray(PINNED["mask"])
    assert float(metrics["critic/loss"]) == pytest.approx(PINNED["loss"], rel=1e-6)
    value = (np.asarray(PINNED["lambda_return"]) * mask).sum() / mask.sum()
    assert float(metrics["critic/value"]) == pytest.approx(value, rel=1e-5)
    again, _ = jax.jit(qmix.loss, static_argnums=3)(after.online, after.target, sequences(), SETTINGS)
    assert float(again) == pytest.approx(PINNED["loss_after"], rel=1e-6)


@pytest.mark.parametrize("most", [10.0, 0.5])
def test_the_gradient_is_cut_down_as_a_whole(most):
    """Adam's first mean is a tenth of the gradient, whose norm is 7.5."""
    cut = SETTINGS.model_copy(update={"max_grad_norm": most})
    after, _ = jax.jit(partial(qmix.update, settings=cut))(worked(), sequences(), STAY)
    mean = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(after.optimizer[0].mu)])
    assert 10 * np.linalg.norm(mean) == pytest.approx(min(PINNED["grad_norm"], most), rel=1e-5)


# Targets.


def test_an_episode_that_has_not_ended_counts_on_what_follows():
    """The same sums where no step is the last one, as if a time limit were none."""
    reward, nothing = jnp.array([[1.0, 0.0, 2.0]]), jnp.zeros((1, 3))
    value = jnp.array([[9.0, 0.5, 1.0, 4.0]])
    got = qmix.lambda_returns(reward, nothing, nothing + 1, value, SETTINGS)
    np.testing.assert_allclose(got, [[3.53612656, 3.93624, 5.96]], rtol=1e-6)


@pytest.mark.parametrize(
    ("weight", "want"), [(0.0, [1 + 0.99 * 5, 0.99 * 6, 2]), (1.0, [1 + 0.99**2 * 2, 0.99 * 2, 2])]
)
def test_lambda_trusts_the_networks_or_the_rewards(weight, want):
    reward, terminated = jnp.array([[1.0, 0.0, 2.0]]), jnp.array([[0.0, 0.0, 1.0]])
    settings = SETTINGS.model_copy(update={"td_lambda": weight})
    value = jnp.array([[4.0, 5.0, 6.0, 7.0]])
    got = qmix.lambda_returns(reward, terminated, jnp.ones((1, 3)), value, settings)
    np.testing.assert_allclose(got, [want], rtol=1e-6)


def test_targets_are_copied_when_they_move():
    start = worked()
    stayed, moved = update(start, sequences(), STAY)[0], update(start, sequences(), MOVE)[0]
    assert same(stayed.target, start.target)
    assert same(stayed.online, moved.online)
    assert same(moved.target, moved.online)
    assert not same(moved.online, start.online)


def test_they_start_as_copies():
    start = small()
    assert same(start.online, start.target)


# Padding.


def test_what_stands_in_the_padding_does_not_count():
    batch = sequences()
    junk = batch._replace(
        observation=batch.observation.at[0, 3:].set(50.0),
        state=batch.state.at[0, 3:].set(-50.0),
        available=batch.available.at[0, 3:].set(True),
        action=batch.action.at[0, 2:].set(0.0),
        reward=batch.reward.at[0, 2:].set(100.0),
    )
    close(update(worked(), junk, MOVE), update(worked(), batch, MOVE))


def test_neither_does_its_length():
    def longer(leaf):
        return jnp.pad(leaf, ((0, 0), (0, 2), *((0, 0),) * (leaf.ndim - 2)))

    close(update(worked(), jax.tree.map(longer, sequences()), MOVE), update(worked(), sequences(), MOVE))


def test_a_batch_of_padding_alone_teaches_nothing():
    nothing = jax.tree.map(jnp.zeros_like, sequences())
    after, metrics = update(worked(), nothing, STAY)
    assert same(after.online, worked().online)
    assert {float(value) for value in metrics.values()} == {0.0}


# Acting.


def test_acting_is_what_training_sees():
    """Step by step with a memory: the best actions by the values of the same episode, unrolled."""
    agent, rng = (
        jax.tree.map(lambda leaf: 5 * leaf, small().online.agent),
        np.random.default_rng(0),
    )  # past steps matter
    observation = jnp.asarray(rng.normal(size=(4, 6, 2, 2)), jnp.float32)
    available = jnp.asarray(rng.random((4, 6, 2, 3)) < 0.6).at[..., 0].set(True)
    memory, actions = qmix.no_memory((4, 2), 3, SETTINGS), []
    for step in range(5):
        action, memory = qmix.act(agent, memory, observation[:, step], available[:, step])
        actions.append(action)
    done = jnp.stack(actions, axis=1)
    rest = jnp.zeros((4, 5))
    batch = Sequences(observation, jnp.zeros((4, 6, 2)), available, done, rest, rest, rest + 1)
    np.testing.assert_array_equal(qmix.best(qmix.action_values(agent, batch), available)[:, :-1], done)
    np.testing.assert_array_equal(memory.last_action, done[:, -1])


@pytest.mark.parametrize("epsilon", [0.0, 0.5, 1.0])
def test_unavailable_actions_are_never_chosen(epsilon):
    rng = np.random.default_rng(1)
    available = jnp.asarray(rng.random((500, 2, 3)) < 0.4).at[..., 2].set(True)
    noise = jnp.asarray(rng.random((500, 2, 4)), jnp.float32).at[:100].set(0)  # the smallest numbers that there are
    observation = jnp.asarray(rng.normal(size=(500, 2, 2)), jnp.float32)
    memory = qmix.no_memory((500, 2), 3, SETTINGS)
    action, _ = qmix.act(small().online.agent, memory, observation, available, noise, epsilon)
    np.testing.assert_array_equal(action.sum(axis=-1), 1)
    assert bool((available | (action == 0)).all())


def test_exploration_is_uniform_over_what_is_available_and_each_agent_explores_for_itself():
    count, agent = 20_000, small().online.agent
    available = jnp.tile(jnp.array([[True, False, True], [True, True, True]]), (count, 1, 1))
    observation, memory = jnp.ones((count, 2, 2)), qmix.no_memory((count, 2), 3, SETTINGS)
    noise = jax.random.uniform(jax.random.key(0), (count, 2, 4))
    action, _ = qmix.act(agent, memory, observation, available, noise, 1.0)
    np.testing.assert_allclose(action.mean(axis=0), [[1 / 2, 0, 1 / 2], [1 / 3] * 3], atol=0.015)

    greedy, _ = qmix.act(agent, memory, observation, available)
    seldom, _ = qmix.act(agent, memory, observation, available, noise, 0.3)
    other = np.asarray((seldom != greedy).any(axis=-1))
    np.testing.assert_allclose(other.mean(axis=0), [0.3 / 2, 0.3 * 2 / 3], atol=0.015)
    assert other.all(axis=1).mean() == pytest.approx(0.3 / 2 * 0.3 * 2 / 3, abs=0.01)


def test_one_environment_needs_no_batch():
    action, memory = qmix.act(
        small().online.agent, qmix.no_memory((2,), 3, SETTINGS), jnp.ones((2, 2)), jnp.ones((2, 3), bool)
    )
    assert action.shape == (2, 3)
    assert memory.hidden.shape == (2, 2)


@pytest.mark.parametrize(("done", "want"), [(0, 1.0), (50_000, 0.525), (100_000, 0.05), (1_000_000, 0.05)])
def test_epsilon_falls_linearly(done, want):
    assert float(qmix.epsilon(done, QMIXSettings())) == pytest.approx(want)
    assert float(qmix.epsilon(jnp.array(done), QMIXSettings())) == pytest.approx(want)


# Seeds, VDN, and the game.


@pytest.mark.parametrize("monotonic", [True, False])
def test_seeds_in_lockstep_learn_as_each_alone(monotonic):
    settings = SETTINGS.model_copy(update={"monotonic": monotonic})
    one = jax.jit(partial(qmix.update, settings=settings))
    alone = [small(seed, monotonic) for seed in range(3)]
    batches = [jax.tree.map(lambda leaf, r=r: jnp.roll(leaf, r, axis=0), sequences()) for r in range(3)]
    together, batch = (jax.tree.map(lambda *leaves: jnp.stack(leaves), *many) for many in (alone, batches))
    got = jax.jit(jax.vmap(partial(qmix.update, settings=settings), (0, 0, None)))(together, batch, MOVE)
    for seed in range(3):
        close(jax.tree.map(lambda leaf, s=seed: leaf[s], got), one(alone[seed], batches[seed], MOVE), atol=1e-5)


def test_vdn_learns_the_agents_alone():
    assert QMIXSettings(monotonic=False) == VDN
    state = small(monotonic=False)
    assert state.online.mixer is None
    value = qmix.action_values(state.online.agent, sequences())
    total = jnp.sum(value[:, :-1] * sequences().action, axis=(-2, -1))
    vdn = SETTINGS.model_copy(update={"monotonic": False})
    error = sequences().mask * (total - qmix.targets(state.target, value, sequences(), vdn)) ** 2
    _, metrics = jax.jit(qmix.update, static_argnums=3)(state, sequences(), STAY, vdn)
    assert float(metrics["critic/loss"]) == pytest.approx(float(error.sum() / 2 / 5), rel=1e-5)


PAYS = jnp.array([[[7.0, 7.0], [7.0, 7.0]], [[0.0, 1.0], [1.0, 8.0]]])
"""What both agents' second actions pay, by the first agent's first action."""
SEEDS, EPISODES, UPDATES = 4, 32, 400


def played(agent, settings, noise=None) -> Sequences:
    """The two-step game of Rashid et al. (2018): both agents see where they are; uniformly random with noise."""
    count = 1 if noise is None else EPISODES
    everywhere, all_of_them = jnp.zeros(count, int), jnp.ones((count, 2, 2), bool)
    memory, place, rooms, actions = qmix.no_memory((count, 2), 2, settings), everywhere, [], []
    for step in range(2):
        rooms.append(jax.nn.one_hot(place, 3))
        seen = jnp.repeat(rooms[-1][:, None], 2, axis=1)
        action, memory = qmix.act(agent, memory, seen, all_of_them, None if noise is None else noise[step], 1.0)
        actions.append(action)
        place = 1 + jnp.argmax(action[:, 0], axis=-1)
    state, action = jnp.stack([*rooms, jnp.zeros((count, 3))], axis=1), jnp.stack(actions, axis=1)
    first, *second = jnp.argmax(jnp.stack([action[:, 0, 0], action[:, 1, 0], action[:, 1, 1]]), axis=-1)
    reward = jnp.stack([jnp.zeros(count), PAYS[first, second[0], second[1]]], axis=1)
    seen, last = jnp.repeat(state[:, :, None], 2, axis=2), jnp.tile(jnp.array([0.0, 1.0]), (count, 1))
    available = jnp.ones((count, 3, 2, 2), bool)
    return Sequences(seen, state, available, action, reward, last, jnp.ones_like(last))


@pytest.mark.parametrize(("monotonic", "reached"), [(True, 8.0), (False, 7.0)])
def test_the_two_step_game(monotonic, reached):
    """A sum cannot say that 8 needs both agents: by it the sure 7 are the most. The mixer can."""
    settings = QMIXSettings(
        hidden=16, embed=8, hypernet=16, learning_rate=5e-3, td_lambda=0.0, target_every=50, monotonic=monotonic
    )

    def learned(key):
        start = qmix.init(key, 2, 3, 2, 3, settings)

        def one(state, turn):
            noise = jax.random.uniform(jax.random.fold_in(key, turn), (2, EPISODES, 2, 3))
            batch = played(state.online.agent, settings, noise)
            return qmix.update(state, batch, (turn + 1) % settings.target_every == 0, settings)[0], None

        state, _ = jax.lax.scan(one, start, jnp.arange(UPDATES))
        return played(state.online.agent, settings).reward.sum()

    returns = jax.jit(jax.vmap(learned))(jax.random.split(jax.random.key(0), SEEDS))
    np.testing.assert_array_equal(returns, reached)
