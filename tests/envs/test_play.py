"""Episodes from the view of a role: all values of a scripted hunt, in which agents leave."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from helpers.toy_envs import toy_spec
from lare_rl.envs.env_errors import EnvOutputError
from lare_rl.envs.families import register_family
from lare_rl.envs.interface import EnvSpec, Team, Timestep
from lare_rl.envs.play import Episode, phi_inputs, play_episodes, play_roles, play_steps, sample_action
from lare_rl.envs.vec_env import LocalVecEnv
from lare_rl.errors import LareError
from lare_rl.tasks.spec import TaskSpec

CAT, MICE = Team("cat", 0, 1), Team("mouse", 1, 3)

ALIVE = np.array([[1, 1, 1], [1, 1, 1], [1, 0, 1], [1, 0, 0]], bool)
"""Before each step, and after the last. One mouse leaves after the second step, the other after the third."""
REWARD = np.array([[0, 0, 0], [1, 2, 4], [0, -8, 2], [5, 0, 6]], np.float32)
"""After each step."""


class Hunt:
    """Three steps of a cat and two mice. Agents observe the time and their index."""

    spec = EnvSpec((CAT, MICE), 2, 2, discrete=True, max_steps=3, state_size=1, agents_leave=True)

    def __init__(self):
        self.seeds, self.closed = [], False

    def reset(self, seed):
        self.seeds.append(seed)
        self.time = 0
        return self.make_timestep()

    def step(self, action):
        self.time += 1
        return self.make_timestep()

    def make_timestep(self):
        return Timestep(
            observation=np.array([[self.time, agent] for agent in range(3)], np.float32) * ALIVE[self.time][:, None],
            state=np.array([10 * self.time], np.float32),
            available=np.ones((3, 2), bool),
            alive=ALIVE[self.time],
            reward=REWARD[self.time],
            terminated=np.array(self.time == 3),
            truncated=np.array(False),
            measures={},
        )

    def render(self): ...

    def close(self):
        self.closed = True


def make_role(team, **changes) -> TaskSpec:
    values = {"name": team, "team": team, "environment": "hunt/field", "observation_size": 2, "action_size": 2}
    return toy_spec(**values | changes)


class SpoiltHunt(Hunt):
    """`fault` is an error of the second step, or what the timesteps have from then on."""

    def __init__(self, fault):
        super().__init__()
        self.fault = fault

    def step(self, action):
        timestep = super().step(action)
        if self.time == 1:
            return timestep
        if isinstance(self.fault, Exception):
            raise self.fault
        return timestep._replace(**self.fault)


@pytest.mark.parametrize(
    ("fault", "content"),
    [
        (EnvOutputError("the reward contains nan"), r"nan, at step 2 of the episode$"),
        (OSError("no\nasset"), "failed in step: no asset$"),
        ({"reward": np.zeros(2, np.float32)}, r"reward of step has the shape \(2,\), .*at step 2 of the episode$"),
        ({"terminated": np.array(False)}, r"3 steps .*max_steps is 3, at step 3 of the episode$"),
    ],
)
def test_faults_of_steps(fault, content):
    with pytest.raises(LareError, match=content):
        list(play_steps(SpoiltHunt(fault), None, np.random.default_rng(0), 0))


def play_hunt(role: TaskSpec) -> Episode:
    return play_roles(Hunt(), (role,), None, np.random.default_rng(0), 0)[0]


def test_episode_has_a_row_for_each_agent_of_the_team():
    episode = play_hunt(make_role("mouse"))
    assert episode.observation.tolist() == [[[0, 1], [0, 2]], [[1, 1], [1, 2]], [[0, 0], [2, 2]]]
    assert episode.next_observation.tolist() == [[[1, 1], [1, 2]], [[0, 0], [2, 2]], [[0, 0], [0, 0]]]
    assert episode.env_action.shape == (3, 2, 2)
    # The agents that acted, and their rewards, even if they left in this step.
    assert episode.alive.tolist() == [[True, True], [True, True], [False, True]]
    assert episode.reward.tolist() == [[2, 4], [-8, 2], [0, 6]]
    assert (episode.team_reward.tolist(), episode.return_) == ([3, -3, 6], 6)
    assert play_hunt(make_role("cat")).team_reward.tolist() == [1, 0, 5]
    assert play_hunt(make_role(None, name="Hunt")).team_reward.tolist() == [1, 0, 5]  # by default the first team


def test_episode_of_states_has_one_row_for_the_team():
    episode = play_hunt(make_role("mouse", credit_scope="state", observation_size=1, action_size=4))
    assert episode.observation.tolist() == [[[0]], [[10]], [[20]]]
    assert episode.next_observation.tolist() == [[[10]], [[20]], [[30]]]
    assert episode.alive.tolist() == [[True]] * 3
    assert episode.reward.tolist() == [[3], [-3], [6]]
    # The actions of both mice, concatenated.
    assert episode.env_action.tolist() == play_hunt(make_role("mouse")).env_action.reshape(3, 1, 4).tolist()


def test_phi_inputs_of_batches():
    """Training has axes for seeds, environments and time in front."""
    action = np.arange(2 * 3 * 2, dtype=np.float32).reshape(2, 3, 2)
    single = Hunt().reset(0)
    timestep = single._replace(observation=np.stack([single.observation] * 2), state=np.array([[7], [8]], np.float32))
    observation, phi_action = phi_inputs("observation", MICE, timestep, action)
    np.testing.assert_array_equal(observation, timestep.observation[:, 1:])
    np.testing.assert_array_equal(phi_action, action[:, 1:])
    state, phi_action = phi_inputs("state", MICE, timestep, action)
    assert (state.tolist(), phi_action.tolist()) == ([[[7]], [[8]]], [[[2, 3, 4, 5]], [[8, 9, 10, 11]]])


# Several episodes

HUNTS: list[Hunt] = []


def make_hunt(task):
    HUNTS.append(Hunt())
    return HUNTS[-1]


register_family("hunt", make_hunt)


def test_each_episode_has_its_own_seed():
    HUNTS.clear()
    first, second, third = play_episodes(make_role("mouse"), 3, seed=40)
    (env,) = HUNTS
    assert (env.seeds, env.closed) == ([40, 41, 42], True)
    # All episodes share one random generator, so their actions differ.
    assert any((first.env_action != other.env_action).any() for other in (second, third))
    for repeat, episode in zip(play_episodes(make_role("mouse"), 2, seed=40), (first, second), strict=True):
        np.testing.assert_array_equal(repeat.env_action, episode.env_action)


def test_policy_with_a_memory_forgets_the_episode_before():
    class Counter:
        def reset(self):
            self.count = 0

        def select_env_action(self, observation, available=None):
            self.count += 1
            return np.array([self.count / 8], np.float32)

    for episode in play_episodes(toy_spec(max_episode_steps=3), 2, Counter()):
        assert episode.env_action[:, 0, 0].tolist() == [0.125, 0.25, 0.375]


def test_policy_receives_the_observation_before_the_step():
    observations = []

    def act(observation):
        observations.append(observation.tolist())
        return np.array([0.25], np.float32)

    (episode,) = play_episodes(toy_spec(max_episode_steps=3), 1, act)
    assert observations == episode.observation[:, 0].tolist()
    assert episode.env_action.tolist() == [[[0.25]]] * 3
    with pytest.raises(LareError, match=r"policy returned array\(0.5\), not .*shape \(1,\)"):
        play_episodes(toy_spec(), 1, lambda observation: 0.5)
    HUNTS.clear()
    with pytest.raises(LareError, match="single agent, and the environment has 3"):
        play_episodes(make_role("cat"), 1, lambda observation: np.float32([1, 0]))
    assert [env.closed for env in HUNTS] == [True]


# Random actions


def sample_discrete(available, rng):
    agents, size = available.shape
    spec = EnvSpec((Team("agent", 0, agents),), 1, size, discrete=True, max_steps=1)
    return sample_action(spec, Hunt().reset(0)._replace(available=available), rng)


@settings(deadline=None, max_examples=40)
@given(available=arrays.arrays(bool, (3, 4)), seed=st.integers(0, 2**32))
def test_random_actions_are_available(available, seed):
    available[:, 2] |= ~available.any(axis=1)
    action = sample_discrete(available, np.random.default_rng(seed))
    assert action.sum(axis=1).tolist() == [1, 1, 1]
    assert available[action == 1].all()


def test_random_actions_are_uniform():
    rng, low, high = np.random.default_rng(0), np.array([[-1, 5], [0, 0]]), np.array([[3, 6], [0, 100]])
    available = np.array([[True, False, True], [True, True, True]])
    frequency = np.mean([sample_discrete(available, rng) for _ in range(1000)], axis=0)
    # Within 4 standard deviations.
    np.testing.assert_allclose(frequency, [[1 / 2, 0, 1 / 2], [1 / 3] * 3], atol=4 * np.sqrt(1 / 4 / 1000))
    bounds = {"low": low.astype(np.float32), "high": high.astype(np.float32)}
    spec = EnvSpec((Team("agent", 0, 2),), 1, 2, discrete=False, max_steps=1, **bounds)
    actions = np.stack([sample_action(spec, Hunt().reset(0), rng) for _ in range(1000)])
    assert ((actions >= low) & (actions <= high)).all()
    shares, span = np.array([0, 0.25, 0.75, 1]), high - low
    error = np.abs(np.quantile(actions, shares, axis=0) - (low + shares[:, None, None] * span))
    assert (error <= 0.05 * span).all()


class Halving(Hunt):
    """It changes its action in place."""

    def step(self, action):
        action *= 0.5
        return super().step(action)


def test_environment_that_changes_its_action():
    envs, action = LocalVecEnv([Halving]), np.ones((1, 3, 2), np.float32)
    envs.reset(np.ones(1, bool), np.zeros(1, int))
    envs.step(action)
    assert (action == 1).all()
