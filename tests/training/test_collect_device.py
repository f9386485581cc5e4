"""Collecting from many copies of an environment in JAX: a toy whose episodes have any length and whose agents leave."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.jax_toy_envs import Echo, echo_spec
from helpers.small_configs import ONE_AGENT, SMALL_SETTINGS, small_config
from lare_rl.algorithms.qmix import qmix
from lare_rl.algorithms.td3 import TD3Settings
from lare_rl.envs.families import register_family
from lare_rl.envs.jax_packages import agent_timestep
from lare_rl.errors import LareError
from lare_rl.training import collect_device
from lare_rl.training.collect_device import DeviceCollector, make_jax_env, unroll_on_device
from lare_rl.training.compiled import compile_functions
from lare_rl.training.policy import get_actor
from lare_rl.training.streams import Stream, stream_keys

SEEDS, ENVS, TIME = (0, 3), 4, 9


class KeyedEcho(Echo):
    """Its state holds a random key. Its reward and its measure are not numbers after the end of an episode."""

    def reset(self, key):
        state, timestep = super().reset(key)
        return (state, key), timestep

    def step(self, state, action, key):
        echo, timestep = super().step(state[0], action, key)
        return (echo, jax.random.split(state[1])[0]), timestep

    def timestep(self, cues, reward):
        reward = jnp.where(cues.step > cues.length, jnp.nan, reward)
        return super().timestep(cues, reward)


ENV = KeyedEcho()
GREEDY = SMALL_SETTINGS["qmix"].model_copy(update={"epsilon_start": 0.0, "epsilon_end": 0.0})
CONFIG = small_config("dense", "qmix", ENV.spec, n_envs=ENVS, rollout_steps=TIME, hyperparameters=GREEDY, capacity=200)


def make_actor(seeds=SEEDS, config=CONFIG):
    learner = compile_functions(config).init(jax.vmap(jax.random.key)(jnp.asarray(seeds)))
    return learner, get_actor(learner.algorithm, 0, config)


@pytest.fixture(scope="module")
def learner():
    return make_actor()


@pytest.fixture(scope="module")
def steps(learner):
    """Three consecutive iterations: [seeds time envs ...]."""
    collector = DeviceCollector(ENV, CONFIG, SEEDS)
    chunks = [jax.tree.map(np.asarray, collector.collect(learner[1], number * ENVS * TIME)) for number in range(3)]
    return jax.tree.map(lambda *arrays: np.concatenate(arrays, axis=1), *chunks)


def split_episodes(ended):
    """Return the steps of each whole episode of one environment."""
    ends = np.flatnonzero(ended) + 1
    return [np.arange(begin, end) for begin, end in zip([0, *ends], ends, strict=False)]


def test_collect_steps_are_consecutive(steps):
    assert steps.action.shape == (2, 3 * TIME, ENVS, 3, 3)
    inside = ~steps.ended[:, :-1]
    assert inside[:, [TIME - 1, 2 * TIME - 1]].any()
    for name in ("observation", "state", "available", "alive"):
        after, before = getattr(steps.next_timestep, name)[:, :-1], getattr(steps.timestep, name)[:, 1:]
        np.testing.assert_array_equal(before[inside], after[inside])
    # Masks are respected.
    assert not steps.timestep.alive.all()
    assert (steps.timestep.available | (steps.action == 0)).all()
    np.testing.assert_array_equal(steps.action.sum(axis=-1), 1)
    np.testing.assert_array_equal(steps.env_action, steps.action)
    assert not steps.next_timestep.reward[~steps.timestep.alive].any()


def test_collect_resets_ended_episodes(steps):
    starts = np.concatenate([np.ones_like(steps.ended[:, :1]), steps.ended[:, :-1]], axis=1)
    np.testing.assert_array_equal(steps.timestep.observation[..., 0, 3] == 0, starts)  # the time
    assert steps.timestep.alive[starts].all()
    assert not steps.timestep.reward[starts].any()
    initial, lengths = [], []
    for seed_index, env_index in np.ndindex(2, ENVS):
        for episode in split_episodes(steps.ended[seed_index, :, env_index]):
            last = seed_index, episode[-1], env_index
            lengths.append(len(episode))
            assert bool(steps.next_timestep.truncated[last]) == (len(episode) == 6)
            assert bool(steps.next_timestep.terminated[last]) == (len(episode) < 6)
            initial.append(steps.timestep.state[seed_index, episode[:3], env_index].tobytes())
    assert set(lengths) == {3, 4, 5, 6}
    assert len(set(initial)) > 0.8 * len(initial)  # some have equal cues by chance


def test_collect_resets_memory_with_episode(learner, steps):
    """The deterministic choices equal those of the recurrent policy, unrolled over each episode alone."""
    n_episodes = 0
    for seed_index, env_index in np.ndindex(2, ENVS):
        agent = jax.tree.map(lambda leaf, i=seed_index: leaf[i], learner[0].algorithm.networks.online.agent)
        for episode in split_episodes(steps.ended[seed_index, :, env_index]):
            memory = qmix.init_memory((3,), 3, GREEDY)
            for t in episode:
                observation, available, action = (
                    array[seed_index, t, env_index]
                    for array in (steps.timestep.observation, steps.timestep.available, steps.action)
                )
                expected, memory = qmix.act(agent, memory, jnp.asarray(observation), jnp.asarray(available))
                np.testing.assert_array_equal(expected, action)
            n_episodes += 1
    assert n_episodes > 30


def test_collect_seeds_do_not_depend_on_each_other(steps):
    reverse = DeviceCollector(ENV, CONFIG, SEEDS[::-1]).collect(make_actor(SEEDS[::-1])[1], 0)
    for a, b in zip(jax.tree.leaves(reverse), jax.tree.leaves(steps), strict=True):
        np.testing.assert_allclose(a, b[::-1, :TIME], rtol=1e-4, atol=1e-5)


def test_reset_with_each_step_changes_nothing(learner, steps, monkeypatch):
    """As a card does if a reset is cheap."""
    assert collect_device.is_reset_cheap(ENV, ENVS)
    monkeypatch.setattr(collect_device, "MAX_RESET_FLOPS", 0)
    assert not collect_device.is_reset_cheap(ENV, ENVS)
    collector = DeviceCollector(ENV, replace(CONFIG, resets_with_steps=True), SEEDS)
    first = jax.tree.map(lambda rows: rows[:, :TIME], steps)
    jax.tree.map(np.testing.assert_array_equal, collector.collect(learner[1], 0), first)


def test_evaluate_equals_plain_loop(learner):
    keys = stream_keys(SEEDS, Stream.EVALUATION_EPISODES, 0)
    unroll = partial(unroll_on_device, ENV, n_episodes=5, config=CONFIG, deterministic=True)
    batch = jax.jit(unroll)(learner[1], keys)
    steps, mask = jax.tree.map(np.asarray, (batch.steps, batch.mask))
    assert mask.shape == (6, 2, 5)
    np.testing.assert_array_equal(mask, np.cumsum(steps.ended, axis=0) - steps.ended == 0)
    assert np.isnan(steps.next_timestep.measures["right"]).any()
    collector = DeviceCollector(ENV, CONFIG, SEEDS)
    evaluation, again, other = (collector.evaluate(learner[1], 5, number) for number in (0, 0, 1))
    np.testing.assert_array_equal(again.returns, evaluation.returns)
    assert not np.array_equal(other.lengths, evaluation.lengths)  # other initial states
    for seed_index, episode in np.ndindex(2, 5):
        return_ = summed_return = 0.0
        for t in range(6):
            index = t, seed_index, episode
            alive, reward = steps.timestep.alive[index], steps.next_timestep.reward[index]
            return_ += reward[alive].mean()
            summed_return += reward[alive].sum()
            if steps.ended[index]:
                break
        assert evaluation.lengths[seed_index, episode] == t + 1
        assert evaluation.returns[seed_index, episode, 0] == pytest.approx(return_, rel=1e-5)
        assert evaluation.summed_returns[seed_index, episode, 0] == pytest.approx(summed_return, rel=1e-5)
        assert evaluation.measures["right"][seed_index, episode] == reward.sum()


class Still:
    """A toy of a single agent whose steps change nothing."""

    spec = ONE_AGENT

    def reset(self, key):
        return (), agent_timestep(self.spec, jnp.zeros(3))

    def step(self, state, action, key):
        return self.reset(key)

    def frames(self, states, credit=None):
        return []


def test_collect_during_the_warmup_and_episode_that_never_ends():
    """Without exploration noise, the policy acts the same in every step."""
    hyperparameters = TD3Settings(hidden=(8,), warmup=400, exploration_noise=0.0)
    config = small_config("dense", env=ONE_AGENT, n_envs=4, rollout_steps=100, hyperparameters=hyperparameters)
    actor = make_actor(config=config)[1]
    warmup, trained = (DeviceCollector(Still(), config, SEEDS).collect(actor, step) for step in (0, 400))
    action = np.asarray(warmup.action).reshape(2, -1)
    np.testing.assert_array_less(np.abs(action), 1)
    for deciles in np.quantile(action, np.linspace(0.1, 0.9, 9), axis=1).T:
        np.testing.assert_allclose(deciles, np.linspace(-0.8, 0.8, 9), atol=0.15)
    assert abs(np.corrcoef(action)[0, 1]) < 0.15
    assert np.ptp(np.asarray(trained.action), axis=(1, 2)).max() < 1e-6
    config = small_config("dense", env=ONE_AGENT, hyperparameters=TD3Settings(hidden=(8,)))
    with pytest.raises(LareError, match=f"has not ended, but max_steps is {ONE_AGENT.max_steps}"):
        DeviceCollector(Still(), config, SEEDS).evaluate(make_actor(config=config)[1], 2)


def test_get_actor_has_the_epsilon_of_the_step(learner):
    config = replace(CONFIG, hyperparameters=SMALL_SETTINGS["qmix"])
    for step, epsilon in ((0, 1.0), (SMALL_SETTINGS["qmix"].epsilon_steps, 0.05)):
        actor = get_actor(learner[0].algorithm, step, config)
        np.testing.assert_allclose(actor.epsilon, [epsilon] * len(SEEDS), rtol=1e-6)


def test_states_with_random_keys_are_restored(learner):
    collectors = [DeviceCollector(ENV, CONFIG, SEEDS) for _ in range(2)]
    collectors[0].collect(learner[1], 0)
    collectors[1].restore(collectors[0].state_dict())
    for name, array in collectors[0].state_dict().items():
        np.testing.assert_array_equal(collectors[1].state_dict()[name], array)
    actions = [collector.collect(learner[1], ENVS * TIME).action for collector in collectors]
    np.testing.assert_array_equal(*actions)
    with pytest.raises(ValueError, match=r"array 0 .*\(2, 5\), not .*\(2, 4\)"):
        collectors[1].restore(
            {name: np.repeat(array, [1, 1, 1, 2], 1) for name, array in collectors[0].state_dict().items()}
        )


CHANGES = {
    "scalar": (lambda t: t._replace(reward=t.reward[0]), r"bad-echo/scalar: reward of reset .*\(\).*\(3,\)"),
    "short": (lambda t: t._replace(observation=t.observation[:, 1:]), r"observation .*\(3, 3\).*\(3, 4\)"),
    "whole": (lambda t: t._replace(reward=t.reward.astype(int)), "reward of reset has the type int32, not float32"),
    "unmeasured": (lambda t: t._replace(measures={}), "measure 'right'"),
    "failing": (lambda t: 1 / 0, "'bad-echo/failing' cannot be compiled: division by zero$"),
}


class BadEcho(Echo):
    """The toy, whose timestep after a reset is changed as the name of the environment says."""

    def __init__(self, task):
        self.change = CHANGES[task.name_in_family][0]

    def reset(self, key):
        state, timestep = super().reset(key)
        return state, self.change(timestep)


register_family("bad-echo", BadEcho)


@pytest.mark.parametrize("name", CHANGES)
def test_arrays_are_those_of_the_spec(name):
    with pytest.raises(LareError, match=CHANGES[name][1]):
        make_jax_env(echo_spec(environment=f"bad-echo/{name}"))
