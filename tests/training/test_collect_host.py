"""Collecting from environments on the host: steps, restored episodes, evaluations, and faults with their place."""

import itertools
from dataclasses import replace
from functools import partial

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.small_configs import ONE_AGENT, SMALL_SETTINGS, small_config
from helpers.toy_envs import pick_spec, toy_spec
from lare_rl.envs.env_errors import EnvOutputError
from lare_rl.envs.gymnasium_env import GymnasiumEnv
from lare_rl.envs.interface import EnvSpec, Team, Timestep, to_env_action
from lare_rl.envs.vec_env import LocalVecEnv
from lare_rl.training import collect_host
from lare_rl.training.collect_host import HostCollector
from lare_rl.training.compiled import compile_functions, init_seeds
from lare_rl.training.divergence import DivergedError
from lare_rl.training.policy import get_actor
from lare_rl.training.streams import Stream, episode_seed, seed_keys, stream_keys
from lare_rl.training.unroll_host import evaluate_batch_on_host, evaluate_policy_on_host, record_on_host


class Wrapped(gymnasium.Wrapper):
    """The toy, in a wrapper that a test chooses."""

    wrap = staticmethod(lambda env: env)

    def __init__(self):
        super().__init__(self.wrap(gymnasium.make("toys/Chase-v0").unwrapped))


gymnasium.register("toys/Wrapped-v0", entry_point=Wrapped, max_episode_steps=20, disable_env_checker=True)
WRAPPED = toy_spec(environment="toys/Wrapped-v0")


class Changed(gymnasium.Wrapper):
    """Episodes of the next of some lengths, in which every reward is 1; and a bad output at the third step, for some seeds."""

    def __init__(self, env, lengths=None, seeds=range(2**31), **bad):
        super().__init__(env)
        self.lengths, self.seeds, self.bad = lengths, seeds, bad

    def reset(self, *, seed=None, options=None):
        self.is_bad, self.steps, self.length = seed in self.seeds, 0, next(self.lengths) if self.lengths else None
        return self.env.reset(seed=seed)

    def step(self, action):
        assert self.steps != self.length, "stepped after the end"
        self.steps += 1
        observation, reward, terminated, truncated, _ = self.env.step(action)
        if self.length:
            reward, terminated = 1.0, self.steps == self.length
        output = {"observation": observation, "reward": reward} | (self.bad if self.is_bad and self.steps == 3 else {})
        return *output.values(), terminated, truncated, {"left": (self.length or 0) - self.steps}


@pytest.fixture
def wrap(monkeypatch):
    """Choose how toys/Wrapped-v0 is changed."""
    return lambda **options: monkeypatch.setattr(Wrapped, "wrap", staticmethod(partial(Changed, **options)))


def local_envs(count, task=None):
    return LocalVecEnv([partial(GymnasiumEnv, task or toy_spec())] * count)


def make_envs(seeds=(0, 1), n_envs=1, task=None):
    envs = local_envs(len(seeds) * n_envs, task)
    return HostCollector(envs, envs, small_config("dense", env=envs.spec, n_envs=n_envs), seeds)


def best_policy(timestep, noise, episode_start):
    """The best policy of the toy, with noise. Actions in [-1, 1] are twice that in the environment."""
    return timestep.observation[..., :1] / 2 + noise


def collect(envs, n_steps, noise=0.0):
    return envs.collect_by(best_policy, np.full((n_steps, *envs.shape, 1, 1), noise, np.float32))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@settings(max_examples=30, deadline=None)
@given(low=st.lists(st.floats(-1e3, 1e3, width=32), min_size=1, max_size=3), width=st.floats(0.125, 1e3, width=32))
def test_to_env_action_stays_in_space(dtype, low, width):
    """Rounding could lead beyond a bound."""
    bounds = np.array(low, dtype) / dtype(3), np.array(low, dtype) / dtype(3) + dtype(width)
    space = gymnasium.spaces.Box(*bounds, dtype=dtype)
    spec = EnvSpec((Team("agent", 0, 1),), 1, len(low), False, 5, 0, low=bounds[0][None], high=bounds[1][None])
    for action in (-1, -0.3, 0.99999994, 1):
        assert space.contains(to_env_action(np.full((1, len(low)), action, np.float32), spec)[0])


def test_episode_seeds_of_streams_differ():
    seeds = {episode_seed(seed, stream, number) for seed in range(3) for stream in Stream for number in range(20)}
    assert len(seeds) == 3 * len(Stream) * 20
    keys = [stream_keys((0, 1), stream, number) for stream in Stream for number in range(3)]
    assert len(np.unique(np.concatenate([jax.random.key_data(pair) for pair in keys]), axis=0)) == 2 * len(keys)


def test_collect_steps_are_consecutive():
    steps, alone = collect(make_envs(n_envs=3), 45), collect(make_envs((1,), 3), 45)
    assert steps.timestep.observation.shape == (2, 45, 3, 1, 2)
    inside = ~steps.ended[:, :-1]
    after, before = steps.next_timestep.observation[:, :-1], steps.timestep.observation[:, 1:]
    np.testing.assert_array_equal(after[inside], before[inside])
    for seed_index, env_index in np.ndindex(2, 3):
        np.testing.assert_array_equal(np.flatnonzero(steps.ended[seed_index, :, env_index]), [19, 39])
    # Initial states depend on the seed alone.
    np.testing.assert_array_equal(alone.timestep.observation[0], steps.timestep.observation[1])
    assert len(np.unique(steps.timestep.observation[:, [0, 20, 40]].reshape(-1, 2), axis=0)) == 18
    assert not steps.next_timestep.terminated.any()
    np.testing.assert_allclose(steps.env_action, 2 * steps.action, rtol=1e-4, atol=1e-6)
    expected = -((steps.env_action[..., 0] - steps.timestep.observation[..., 0]) ** 2)
    np.testing.assert_allclose(steps.next_timestep.reward, expected, rtol=1e-4, atol=1e-6)
    beyond = collect(make_envs(), 5, noise=3)  # stored as chosen
    assert (beyond.action > 1).all()
    np.testing.assert_array_equal(beyond.env_action, 2)


def test_collect_tells_policy_episode_starts_and_overwrites_nothing():
    starts, envs = [], make_envs((0,), 2)

    def policy(timestep, noise, episode_start):
        starts.append(episode_start.all() + 2 * episode_start.any())
        return noise

    for n_steps in (21, 20):
        envs.collect_by(policy, np.zeros((n_steps, *envs.shape, 1, 1), np.float32))
    assert np.flatnonzero(np.array(starts) == 3).tolist() == [0, 20, 40]
    assert starts.count(0) == 38
    envs = make_envs()
    results = collect(envs, 7), envs.state_dict()
    copies = jax.tree.map(np.copy, results)
    collect(envs, 30, noise=0.1)
    jax.tree.map(np.testing.assert_array_equal, results, copies)


@pytest.mark.parametrize(("limit", "ends", "terminated"), [(5, [4, 9, 14, 19], []), (9, [6, 13], [6, 13])])
def test_collect_distinguishes_termination(limit, ends, terminated, wrap):
    wrap(lengths=itertools.repeat(7))
    steps = collect(make_envs((0,), task=WRAPPED.model_copy(update={"max_episode_steps": limit})), 20)
    np.testing.assert_array_equal(np.flatnonzero(steps.ended[0]), ends)
    np.testing.assert_array_equal(np.flatnonzero(steps.next_timestep.terminated[0]), terminated)


def test_restore_drops_other_observations_and_episodes_that_end_early(wrap):
    envs, restored = make_envs((0, 4), 2), make_envs((0, 4), 2)
    collect(envs, 27)
    state = envs.state_dict()
    dropped, (message,) = restored.restore(state | {"observation3": state["observation3"] + 1})
    assert message.startswith("episode 1 of seed 4 in environment 1 was dropped after 7 steps")
    assert dropped.tolist() == [[False, False], [False, True]]
    state = restored.state_dict()
    assert state["episode"].tolist() == [1, 1, 1, 2]
    assert [len(state[f"actions{i}"]) for i in range(4)] == [7, 7, 7, 0]
    wrap(lengths=iter((9, 2, 9)))
    envs = make_envs((0,), task=WRAPPED)
    collect(envs, 5)
    dropped, _ = envs.restore(envs.state_dict())
    assert dropped.all()


class Unrepeatable:
    """As SMAC: the seed has no effect, and an action that is not available is an error."""

    spec = replace(ONE_AGENT, observation_size=1, action_size=3, discrete=True, masks_actions=True)
    n_resets = 0

    def reset(self, seed):
        Unrepeatable.n_resets += 1
        self.start, self.t = Unrepeatable.n_resets, 0
        return self._timestep()

    def step(self, action):
        assert self._available()[0, np.argmax(action[0])]
        self.t += 1
        return self._timestep()

    def render(self):
        pass

    def close(self):
        pass

    def _available(self):
        return np.arange(3)[None] == (self.start + self.t) % 3

    def _timestep(self):
        observation = np.full((1, 1), self.start, np.float32)
        return Timestep(
            observation, np.zeros(0, np.float32), self._available(), np.ones(1, bool), np.zeros(1, np.float32),
            np.array(False), np.array(self.t >= 12), {},
        )  # fmt: skip


def test_restore_drops_an_episode_whose_actions_are_not_available_any_more():
    config = small_config("episodic", "ppo", Unrepeatable.spec, rollout_steps=4)
    makers = [Unrepeatable]
    envs, restored = (HostCollector(LocalVecEnv(makers), LocalVecEnv(makers), config, [0]) for _ in range(2))
    envs.collect_by(lambda timestep, *_: timestep.available.astype(np.float32), np.zeros((4, 1, 1, 1, 3), np.float32))
    dropped, (message,) = restored.restore(envs.state_dict())
    assert dropped.all()
    assert "dropped after 4 steps" in message


def proportional(factor):
    return lambda timestep, episode_start: factor * timestep.observation[..., :1] / 2


def test_evaluate_initial_states_and_returns():
    def returns(seeds=(0, 1), first=0, factor=0.0):
        return evaluate_batch_on_host(local_envs(3 * len(seeds)), proportional(factor), seeds, 3, first=first).returns[
            ..., 0
        ]

    expected = returns()
    assert len(set(expected.ravel())) == 6
    np.testing.assert_array_equal(returns(), expected)
    np.testing.assert_array_equal(returns((1, 2))[0], expected[1])
    np.testing.assert_array_equal(returns(first=1)[:, :2], expected[:, 1:])
    np.testing.assert_allclose(returns(factor=1.0), 0, atol=1e-4)  # the best policy of the toy
    env = gymnasium.make("toys/Chase-v0")
    for (seed, number), return_ in np.ndenumerate(expected):
        observation, _ = env.reset(seed=episode_seed(seed, Stream.EVALUATION_EPISODES, number))
        total = 0.0
        for _ in range(20):
            total -= observation[0] ** 2
            observation, *_ = env.step(np.zeros(1, np.float32))
        assert return_ == pytest.approx(total, rel=1e-4)


def test_evaluated_episode_does_not_depend_on_the_number_of_environments():
    """Neither its initial state nor the choices that a policy samples."""
    config = small_config("dense", "ppo", local_envs(1, pick_spec()).spec)
    learner = init_seeds(compile_functions(config), seed_keys(jnp.array([0, 3]), 0))
    actor = get_actor(learner.algorithm, 0, config)
    results, steps, episodes = [], [], []
    for width in (5, 2):
        envs, listeners = local_envs(2 * width, pick_spec()), (lambda: steps.append(len(episodes)), episodes.append)
        results.append(evaluate_policy_on_host(envs, config, actor, (0, 3), 5, 1, *listeners))
    assert steps == [number for number in range(4) for _ in range(20)]
    assert episodes == [5, 2, 4, 5]
    assert results[0].returns.shape == (2, 5, 1)
    assert len(np.unique(results[0].returns)) > 2
    jax.tree.map(np.testing.assert_array_equal, *results)


def test_evaluate_episodes_of_different_lengths(wrap):
    wrap(lengths=iter((3, 1, 7) * 2))
    envs = local_envs(3, WRAPPED.model_copy(update={"measures": ("left",)}))
    evaluation = evaluate_batch_on_host(envs, proportional(0.0), [0], 3)
    np.testing.assert_array_equal(evaluation.returns[..., 0], [[3, 1, 7]])
    np.testing.assert_array_equal(evaluation.summed_returns, evaluation.returns)
    np.testing.assert_array_equal(evaluation.lengths, [[3, 1, 7]])
    np.testing.assert_array_equal(evaluation.measures["left"], [[0, 0, 0]])
    batch = record_on_host(envs, proportional(0.0), [0], [1, 2, 3])
    np.testing.assert_array_equal(batch.mask.sum(axis=0), [[3, 1, 7]])
    np.testing.assert_array_equal((batch.steps.next_timestep.reward[..., 0] * batch.mask).sum(axis=0), [[3, 1, 7]])


def test_actions_are_random_until_the_end_of_the_warmup(monkeypatch):
    settings = SMALL_SETTINGS["td3"].model_copy(update={"warmup": 8})
    envs = local_envs(2)
    config = small_config("dense", env=envs.spec, hyperparameters=settings)
    half = np.full((2, 1, 1, 1), 0.5, np.float32)
    monkeypatch.setattr(collect_host, "make_host_policy", lambda *_, **options: lambda memory, *inputs: (half, memory))
    collector = HostCollector(envs, local_envs(2), config, (0, 1))
    warmup, first = (collector.collect(None, step).action for step in (4, 8))
    assert len(np.unique(warmup)) == warmup.size == 8
    assert (first == 0.5).all()


def test_policy_that_is_nan_is_reported():
    action, envs = np.float32([[[[0]]], [[[np.nan]]]]), make_envs()
    with pytest.raises(DivergedError, match="policy of seed 1"):
        envs.collect_by(lambda timestep, noise, episode_start: action, np.zeros((1, 2, 1, 1, 1)))
    with pytest.raises(DivergedError, match="policy of seed 1"):
        evaluate_batch_on_host(local_envs(2), lambda timestep, episode_start: action, (0, 1), 1)


def test_collect_locates_bad_outputs(wrap):
    """The reward in the second episode of the second environment of seed 9, which is the seed's episode number 3.

    The fourth environment of the run has a single number in the message.
    """
    wrap(observation=np.zeros(3))
    with pytest.raises(EnvOutputError, match=r"observation.*\(3,\).*, at step 3 of episode 0 of seed 4$"):
        collect(make_envs((4,), task=WRAPPED), 20)
    seed = episode_seed(9, Stream.TRAINING_EPISODES, 3)
    wrap(reward=float("nan"), seeds={seed})
    with pytest.raises(
        EnvOutputError, match=r"^the environment: .*reward.*nan.*, at step 3 of episode 1 of seed 9 in environment 1$"
    ):
        collect(make_envs((4, 9), 2, task=WRAPPED), 40)


def test_environments_are_closed_if_those_for_evaluations_cannot_be_made(monkeypatch):
    envs, closed = local_envs(1), []
    batches = iter([envs])
    monkeypatch.setattr(envs, "close", lambda: closed.append(envs))
    monkeypatch.setattr(collect_host, "n_open_envs", lambda *_: 1)
    monkeypatch.setattr(collect_host, "make_vec_env", lambda *_, **options: next(batches))
    with pytest.raises(StopIteration):
        collect_host.make_host_collector(toy_spec(), small_config("dense", env=envs.spec), (0,), 1)
    assert closed == [envs]


def test_restore_and_evaluate_locate_bad_outputs(wrap):
    """The step is that of the repeated or evaluated episode."""
    envs = make_envs((4,), task=WRAPPED)
    collect(envs, 27)
    wrap(reward=float("nan"))
    with pytest.raises(EnvOutputError, match=r"reward.*nan.*, at step 3 of episode 1 of seed 4$"):
        make_envs((4,), task=WRAPPED).restore(envs.state_dict())
    wrap(reward=float("nan"), seeds={episode_seed(1, Stream.EVALUATION_EPISODES, 2)})
    envs = local_envs(4, WRAPPED)
    evaluate_batch_on_host(envs, proportional(0.0), (0, 1), 2)
    with pytest.raises(EnvOutputError, match=r"nan.*, at step 3 of the episode, in an evaluation of seed 1$"):
        evaluate_batch_on_host(envs, proportional(0.0), (0, 1), 2, first=1)
