"""Episodes as a role is judged: every number of a scripted hunt, in which some leave."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from helpers.toy_envs import toy_spec
from lare_rl.envs.families import register_family
from lare_rl.envs.interface import EnvSpec, Team, Timestep
from lare_rl.envs.play import Episode, find_team, phi_inputs, play_episode, play_episodes, play_steps, sample_action
from lare_rl.errors import LareError
from lare_rl.tasks.spec import TaskSpec

CAT, MICE = Team("cat", 0, 1), Team("mouse", 1, 3)

ALIVE = np.array([[1, 1, 1], [1, 1, 1], [1, 0, 1], [1, 0, 0]], bool)
"""Before each step, and after the last: one mouse leaves after the second step, the other after the third."""
REWARD = np.array([[0, 0, 0], [1, 2, 4], [0, -8, 2], [5, 0, 6]], np.float32)
"""By the step that led there."""


class Hunt:
    """Three steps of a cat and two mice; what is seen tells the step and the agent."""

    spec = EnvSpec(
        (CAT, MICE),
        observation_size=2,
        action_size=2,
        discrete=True,
        max_steps=3,
        state_size=1,
        agents_leave=True,
        masks_actions=True,
    )

    def __init__(self, ends="terminated"):
        self.ends, self.seeds, self.closed = ends, [], False

    def reset(self, seed):
        self.seeds.append(seed)
        self.time = 0
        return self.make_timestep()

    def step(self, action):
        self.time += 1
        return self.make_timestep()

    def make_timestep(self):
        available = np.ones((3, 2), bool)
        available[2, 1] = self.time != 1
        over = self.time == 3
        return Timestep(
            observation=np.array([[self.time, agent] for agent in range(3)], np.float32) * ALIVE[self.time][:, None],
            state=np.array([10 * self.time], np.float32),
            available=available,
            alive=ALIVE[self.time],
            reward=REWARD[self.time],
            terminated=np.array(over and self.ends == "terminated"),
            truncated=np.array(over and self.ends == "truncated"),
            measures={},
        )

    def render(self): ...

    def close(self):
        self.closed = True


def role(team, **changes) -> TaskSpec:
    values = {"name": team, "team": team, "environment": "hunt/field", "observation_size": 2, "action_size": 2}
    return toy_spec(**values | changes)


def played(of: TaskSpec, **keys) -> Episode:
    return play_episode(Hunt(**keys), of, None, np.random.default_rng(0), 0)


def test_a_step_has_a_row_for_each_agent_of_the_team():
    episode = played(role("mouse"))
    assert episode.observation.tolist() == [[[0, 1], [0, 2]], [[1, 1], [1, 2]], [[0, 0], [2, 2]]]
    assert episode.next_observation.tolist() == [[[1, 1], [1, 2]], [[0, 0], [2, 2]], [[0, 0], [0, 0]]]
    assert episode.env_action.shape == (3, 2, 2)
    # Who acted, and what that paid, although one of them has left by it.
    assert episode.alive.tolist() == [[True, True], [True, True], [False, True]]
    assert episode.reward.tolist() == [[2, 4], [-8, 2], [0, 6]]
    assert episode.team_reward.tolist() == [3, -3, 6]
    assert episode.return_ == 6
    assert played(role("cat")).team_reward.tolist() == [1, 0, 5]


def test_where_the_state_is_judged_a_step_has_one_row_for_the_team():
    episode = played(role("mouse", judged_from="state", observation_size=1, action_size=4))
    assert episode.observation.tolist() == [[[0]], [[10]], [[20]]]
    assert episode.next_observation.tolist() == [[[10]], [[20]], [[30]]]
    assert episode.alive.tolist() == [[True]] * 3
    assert episode.reward.tolist() == [[3], [-3], [6]]
    assert (episode.team_reward.tolist(), episode.return_) == ([3, -3, 6], 6)
    # The mice's choices, one after the other.
    assert episode.env_action.tolist() == played(role("mouse")).env_action.reshape(3, 1, 4).tolist()


def test_rows_of_many_steps_at_once():
    """Training has axes for seeds, environments and time in front."""
    action = np.arange(2 * 3 * 2, dtype=np.float32).reshape(2, 3, 2)
    actual = Hunt().reset(0)
    timestep = actual._replace(observation=np.stack([actual.observation] * 2), state=np.array([[7], [8]], np.float32))
    phi_observation, phi_action = phi_inputs("observation", MICE, timestep, action)
    np.testing.assert_array_equal(phi_observation, timestep.observation[:, 1:])
    np.testing.assert_array_equal(phi_action, action[:, 1:])
    phi_observation, phi_action = phi_inputs("state", MICE, timestep, action)
    assert phi_observation.tolist() == [[[7]], [[8]]]
    assert phi_action.tolist() == [[[2, 3, 4, 5]], [[8, 9, 10, 11]]]


@pytest.mark.parametrize(("name", "team"), [("cat", CAT), ("mouse", MICE), (None, CAT)])
def test_find_team(name, team):
    assert find_team(role("cat").model_copy(update={"team": name}), Hunt.spec) == team


@pytest.mark.parametrize("ends", ["terminated", "truncated"])
def test_an_episode_ends_however_it_ends(ends):
    env = Hunt(ends=ends)
    steps = list(play_steps(env, None, np.random.default_rng(0), 5))
    assert len(steps) == 3
    assert [before.observation[0, 0] for before, *_ in steps] == [0, 1, 2]
    assert [after.observation[0, 0] for *_, after in steps] == [1, 2, 3]
    assert env.seeds == [5]


# Many of them.


HUNTS: list[Hunt] = []


def make_hunt(task):
    HUNTS.append(Hunt())
    return HUNTS[-1]


register_family("hunt", make_hunt)


@pytest.fixture
def hunts() -> list[Hunt]:
    HUNTS.clear()
    return HUNTS


def test_every_episode_has_a_seed_of_its_own(hunts):
    first, second, third = play_episodes(role("mouse"), 3, seed=40)
    (env,) = hunts
    assert (env.seeds, env.closed) == ([40, 41, 42], True)
    # One stream of chance goes through all of them: other episodes, other actions.
    assert any((first.env_action != other.env_action).any() for other in (second, third))
    again = play_episodes(role("mouse"), 2, seed=40)
    for actual, other in zip(again, (first, second), strict=True):
        np.testing.assert_array_equal(actual.env_action, other.env_action)


def test_the_environment_is_closed_when_a_policy_fails(hunts):
    def fails(observation):
        raise LareError("no idea")

    with pytest.raises(LareError, match="no idea"):
        play_episodes(role("cat"), 1, fails)
    assert [env.closed for env in hunts] == [True]


def test_a_policy_acts_on_what_it_sees():
    """`test_reflect.py` has it in whole episodes; here, that it sees the step's own observation, not the one after."""
    phi_observation = []

    def goes(observation):
        phi_observation.append(observation.tolist())
        return np.array([0.25], np.float32)

    (episode,) = play_episodes(toy_spec(max_episode_steps=3), 1, goes)
    assert phi_observation == episode.observation[:, 0].tolist()
    assert episode.env_action.tolist() == [[[0.25]]] * 3


# Random actions.


def make_choices(available) -> tuple[EnvSpec, Timestep]:
    agents, size = available.shape
    spec = EnvSpec((Team("agent", 0, agents),), 1, size, discrete=True, max_steps=1)
    return spec, Hunt().reset(0)._replace(available=available)


@given(available=arrays.arrays(bool, (3, 4)), seed=st.integers(0, 2**32))
def test_a_random_choice_is_one_that_there_is(available, seed):
    available[:, 2] |= ~available.any(axis=1)
    action = sample_action(*make_choices(available), np.random.default_rng(seed))
    assert action.sum(axis=1).tolist() == [1, 1, 1]
    assert available[action == 1].tolist() == [True] * 3


def test_every_choice_that_there_is_comes_as_often():
    available = np.array([[True, False, True], [True, True, True]])
    random = np.random.default_rng(0)
    often = np.mean([sample_action(*make_choices(available), random) for _ in range(3000)], axis=0)
    # Within 4 standard deviations.
    np.testing.assert_allclose(often, [[1 / 2, 0, 1 / 2], [1 / 3] * 3], atol=4 * np.sqrt(1 / 4 / 3000))


def test_random_numbers_fill_their_bounds_evenly():
    low, high = np.array([[-1, 5], [0, 0]], np.float32), np.array([[3, 6], [0, 100]], np.float32)
    spec = EnvSpec((Team("agent", 0, 2),), 1, 2, discrete=False, max_steps=1, low=low, high=high)
    random, timestep = np.random.default_rng(0), Hunt().reset(0)
    actions = np.stack([sample_action(spec, timestep, random) for _ in range(2000)])
    assert ((actions >= low) & (actions <= high)).all()
    np.testing.assert_allclose(
        np.quantile(actions, [0.25, 0.75], axis=0), [low + (high - low) / 4, high - (high - low) / 4], atol=4
    )
    np.testing.assert_allclose(actions.min(axis=0), low, atol=0.2)
    np.testing.assert_allclose(actions.max(axis=0), high, atol=0.2)
