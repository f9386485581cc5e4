"""The assigner receives the steps of a team: rows, alive agents, and the mean of their rewards."""

import numpy as np
import pytest
from gymnasium import spaces
from pettingzoo.test import parallel_api_test

from helpers.logged_envs import RecordingAssigner
from helpers.parallel_toy_envs import Toy
from helpers.toy_envs import toy_spec
from lare_rl.envs.episodic import TRUE_REWARD
from lare_rl.errors import LareError
from lare_rl.integrations.pettingzoo import CreditParallel
from lare_rl.integrations.recorder import CREDIT_STEP

NAMES = ("a_0", "a_1", "a_2")


class LoggedTeam(Toy):
    """Pays random rewards, and logs (observation, action, next observation, reward) of each agent that acts."""

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.random, self.log, self.level = np.random.default_rng(0), [], 0

    def observe(self, agent):
        return np.float32([self.possible_agents.index(agent), self.steps])

    def step(self, actions):
        before = {agent: self.observe(agent) for agent in self.agents}
        observations, _, terminated, truncated, infos = super().step(actions)
        rewards = {agent: float(self.random.normal()) for agent in observations}
        self.log.append(
            {agent: (before[agent], actions[agent], observations[agent], rewards[agent]) for agent in before}
        )
        if not self.agents:
            next(iter(infos.values()))["level"] = self.level
        return observations, rewards, terminated, truncated, infos


def make_assigner(method="ircr", agents=3, **changes):
    values = {"observation_space": 2, "action_space": spaces.Discrete(3), "max_steps": 5}
    return RecordingAssigner(method, agents=agents, **(values | changes))


def play(env, seed=0):
    """Play one episode of random actions. Return the results of `step`."""
    random, results = np.random.default_rng(seed), []
    env.reset(seed=seed)
    while env.agents:
        results.append(env.step({agent: int(random.integers(3)) for agent in env.agents}))
    return results


@pytest.mark.parametrize(
    "presence", [{"leaves": {"a_1": 2, "a_2": 4}}, {"leaves": {"a_0": 3}, "joins": {"a_2": 2}}], ids=str
)
def test_steps(presence):
    team, credit = LoggedTeam(NAMES, **presence), make_assigner()
    wrapped = CreditParallel(team, credit, pay="environment")
    returns = []
    for seed in range(4):
        team.log.clear()
        results = play(wrapped, seed)
        returns.append(sum(np.mean([reward for *_, reward in step.values()]) for step in team.log))
        first = credit.store.n_added - len(team.log)
        for number, (step, result) in enumerate(zip(team.log, results, strict=True), start=first):
            assert credit.store.alive[number].tolist() == [name in step for name in NAMES]
            for index, name in enumerate(NAMES):
                if name not in step:
                    assert not credit.recorded[number][index, 2:5].any()  # no action
                    continue
                observation, action, next_observation, reward = step[name]
                expected = np.concatenate([observation, np.eye(3)[action], next_observation])
                np.testing.assert_array_equal(credit.recorded[number][index], expected)
                assert result[1][name] == reward
    assert [episode.return_ for episode in credit.store.episodes.values()] == pytest.approx(returns)
    assert credit.store.dropped == credit.n_fits == 0


class LenientTeam(LoggedTeam):
    """Ignores actions for agents that have left."""

    def step(self, actions):
        return super().step({agent: actions[agent] for agent in self.agents})


def test_actions_of_agents_that_have_left_do_not_count():
    team, credit = LenientTeam(NAMES, leaves={"a_1": 2}), make_assigner()
    wrapped = CreditParallel(team, credit, pay="environment")
    wrapped.reset(seed=0)
    while wrapped.agents:
        wrapped.step(dict.fromkeys(NAMES, 0))
    present = [[name in step for name in NAMES] for step in team.log]
    assert credit.store.alive[: len(present)].tolist() == present
    assert not all(map(all, present))


def test_rewards():
    team, credit = LoggedTeam(NAMES, leaves={"a_1": 2}), make_assigner("rd-linear")
    wrapped = CreditParallel(team, credit)
    assert all(reward == 0 for step in play(wrapped) for reward in step[1].values())  # before the first fit
    for seed in range(1, 12):
        team.log.clear()
        results = play(wrapped, seed)
    for (_, rewards, _, _, infos), step in zip(results, team.log, strict=True):
        assert rewards.keys() == infos.keys() == step.keys()
        for agent in rewards:
            assert infos[agent][TRUE_REWARD] == step[agent][3]
            assert "count" in infos[agent]
    assert credit.n_fits == credit.store.n_added
    _, rewards, _, _, infos = results[-1]
    for agent, reward in rewards.items():
        r_hat = credit.rewards_at(infos[agent][CREDIT_STEP])
        assert r_hat.shape == (3,)
        assert reward == pytest.approx(float(r_hat[NAMES.index(agent)]), rel=1e-5) != 0


def test_agent_that_joins_is_paid_when_it_acts():
    """Before an episode ends, ircr pays 0.5 to each agent that acts."""
    team = LoggedTeam(NAMES, joins={"a_2": 2})
    results = play(CreditParallel(team, make_assigner()))
    for (_, rewards, *_), step in zip(results[:-1], team.log[:-1], strict=True):
        assert {agent for agent, reward in rewards.items() if reward} == set(step)
    assert any(len(rewards) > len(step) for (_, rewards, *_), step in zip(results, team.log, strict=True))


def test_groups_are_read_from_info():
    """Here from that of any agent that has it."""
    credit = make_assigner("bayes", task=toy_spec(observation_size=2, action_size=3, group="level"))
    team = LoggedTeam(NAMES)
    wrapped = CreditParallel(team, credit, pay="environment")
    for level in (5, 7, 5):
        team.level = level
        play(wrapped)
    assert credit.group_names == {5: 0, 7: 1}
    assert [episode.level for episode in credit.store.episodes.values()] == [0, 1, 0]


def test_dict_space():
    space = spaces.Dict(position=spaces.Box(-9, 9, (1,)), count=spaces.Discrete(9))
    team = LoggedTeam(NAMES[:2], observations=dict.fromkeys(NAMES[:2], space))
    team.observe = lambda agent: {"position": np.zeros(1, np.float32), "count": team.steps}
    credit = make_assigner(agents=2, observation_space=10)
    wrapped = CreditParallel(team, credit)
    wrapped.reset(seed=0)
    wrapped.step(dict.fromkeys(NAMES[:2], 0))
    credit.recorded.clear()
    play(wrapped)  # drops the running episode
    assert (credit.store.n_ended, credit.store.dropped) == (1, 1)
    np.testing.assert_array_equal([credit.recorded[t][0, 14:23] for t in range(1, 6)], np.eye(9)[1:6])


def test_box_without_an_axis():
    box = spaces.Box(-9, 9, ())
    team = LoggedTeam(NAMES[:2], observations=dict.fromkeys(NAMES[:2], box), actions=dict.fromkeys(NAMES[:2], box))
    team.observe = lambda agent: np.array(team.steps, np.float32)
    credit = make_assigner(agents=2, observation_space=box, action_space=box)
    wrapped = CreditParallel(team, credit)
    wrapped.reset(seed=0)
    wrapped.step(dict.fromkeys(NAMES[:2], np.array(7, np.float32)))
    np.testing.assert_array_equal(credit.recorded[0][:, :3], [[0, 7, 1]] * 2)


def test_agents_that_are_listed_after_they_left():
    class Listed(LoggedTeam):
        def step(self, actions):
            self.agents = list(actions)
            result = super().step(actions)
            self.agents = list(NAMES)
            return result

    credit = make_assigner()
    wrapped = CreditParallel(Listed(NAMES, leaves={"a_1": 2}), credit)
    wrapped.reset(seed=3)
    for acting in [NAMES] * 2 + [("a_0", "a_2")] * 3:
        wrapped.step(dict.fromkeys(acting, 0))
    assert credit.store.n_ended == 1
    assert credit.store.alive[:5, 1].tolist() == [True, True, False, False, False]
    with pytest.raises(LareError, match="call reset"):
        wrapped.step({})


def test_checker_of_pettingzoo(recwarn):
    parallel_api_test(CreditParallel(LoggedTeam(NAMES), make_assigner()), num_cycles=20)
    recwarn.clear()


@pytest.mark.parametrize(
    ("team", "changes", "message"),
    [
        (
            Toy(NAMES, actions={"a_0": spaces.Discrete(3), "a_1": spaces.Discrete(2), "a_2": spaces.Discrete(3)}),
            {},
            "same action space: 'a_1'",
        ),
        (Toy(NAMES), {"observation_space": 7}, "observations .* 2 numbers.* 7"),
    ],
)
def test_bad_arguments(team, changes, message):
    with pytest.raises(LareError, match=message):
        CreditParallel(team, make_assigner(**changes))
