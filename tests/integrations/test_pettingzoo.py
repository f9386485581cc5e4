"""A team is shown as its agents act: rows, who is there, and the mean of what they are paid."""

import numpy as np
import pytest
from gymnasium import spaces
from pettingzoo.test import parallel_api_test

from helpers.parallel_toys import Toy
from helpers.shown import SMALL
from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.envs.episodic import TRUE_REWARD
from lare_rl.errors import LareError
from lare_rl.integrations.gymnasium import CREDIT_STEP
from lare_rl.integrations.pettingzoo import CreditParallel

NAMES = ("a_0", "a_1", "a_2")


class Kept(Toy):
    """Rewards are random, and what happens is kept: who acted, what they did, saw and were paid."""

    def __init__(self, *args, **more):
        super().__init__(*args, **more)
        self.random, self.log = np.random.default_rng(0), []

    def seen(self, agent):
        return np.float32([self.possible_agents.index(agent), self.steps])

    def step(self, actions):
        acted, before = list(self.agents), {agent: self.seen(agent) for agent in self.agents}
        observations, _, terminated, truncated, infos = super().step(actions)
        rewards = {agent: float(self.random.normal()) for agent in observations}
        own = {agent: (before[agent], actions[agent], observations[agent], rewards[agent]) for agent in acted}
        self.log.append(own)
        return observations, rewards, terminated, truncated, infos


def credit_for(method="rrdu-next", agents=3, **changes):
    values = {"observation_space": 2, "action_space": spaces.Discrete(3), "max_steps": 5, "capacity": 500}
    return CreditAssigner(method, agents=agents, settings=SMALL, **(values | changes))


def play(environment, seed=0):
    """One episode of random actions; what each call gave."""
    random, found = np.random.default_rng(seed), []
    environment.reset(seed=seed)
    while environment.agents:
        found.append(environment.step({agent: int(random.integers(3)) for agent in environment.agents}))
    return found


@pytest.mark.parametrize(
    "how", [{}, {"leaves": {"a_1": 2, "a_2": 4}}, {"leaves": {"a_0": 3}, "joins": {"a_2": 2}}], ids=str
)
def test_an_assigner_is_shown_what_the_agents_do(how):
    toy = Kept(NAMES, **how)
    credit = credit_for()
    wrapped = CreditParallel(toy, credit, pay="environment")
    scores = []
    for seed in range(4):
        toy.log.clear()
        play(wrapped, seed)
        credit.look()
        scores.append(sum(np.mean([row[3] for row in step.values()]) for step in toy.log))
        first = credit.store.steps - len(toy.log)
        for place, step in enumerate(toy.log):
            for agent, name in enumerate(NAMES):
                assert credit.store.alive[first + place, agent] == (name in step)
                if name in step:
                    before, action, after, _ = step[name]
                    want = np.concatenate([after, np.eye(3)[action]])
                    np.testing.assert_array_equal(credit.store.features[first + place, agent], want)
                    assert before[1] == place
    assert [one.score for one in credit.store.episodes.values()] == pytest.approx(scores)
    assert credit.store.dropped == 0


def test_each_agent_that_acts_is_paid():
    toy, credit = Kept(NAMES, leaves={"a_1": 2}), credit_for("rd-linear")
    wrapped = CreditParallel(toy, credit)
    assert all(paid == 0 for step in play(wrapped) for paid in step[1].values())  # nothing is known yet
    for seed in range(1, 12):
        toy.log.clear()
        found = play(wrapped, seed)
    for (_, rewards, _, _, infos), kept in zip(found, toy.log, strict=True):
        assert rewards.keys() == infos.keys() == kept.keys()
        for agent, paid in rewards.items():
            assert infos[agent][TRUE_REWARD] == kept[agent][3]
            assert "count" in infos[agent]
            r_hat = credit.rewards_at(infos[agent][CREDIT_STEP])
            assert r_hat.shape == (3,)
            if kept is toy.log[-1]:
                assert paid == pytest.approx(float(r_hat[NAMES.index(agent)]), rel=1e-5)
                assert paid != 0


def test_a_reset_in_the_middle_gives_the_episode_up():
    toy, credit = Kept(NAMES), credit_for()
    wrapped = CreditParallel(toy, credit)
    wrapped.reset(seed=0)
    wrapped.step(dict.fromkeys(NAMES, 0))
    play(wrapped)
    assert (credit.store.ended, credit.store.dropped) == (1, 1)


def test_a_team_may_be_one():
    toy, credit = Kept(("a_0",)), credit_for(agents=1, max_steps=None)
    play(CreditParallel(toy, credit))
    (kept,) = credit.store.episodes.values()
    assert kept.score == sum(step["a_0"][3] for step in toy.log)


def test_spaces_of_other_kinds_become_rows():
    parts = spaces.Dict(place=spaces.Box(-9, 9, (1,)), count=spaces.Discrete(9))
    toy = Kept(NAMES[:2], observations=dict.fromkeys(NAMES[:2], parts))
    toy.seen = lambda agent: {"place": np.zeros(1, np.float32), "count": toy.steps}
    credit = credit_for(agents=2, observation_space=10)
    play(CreditParallel(toy, credit))
    credit.look()
    np.testing.assert_array_equal(credit.store.features[:5, 0, 1:10], np.eye(9)[1:6])


def test_pettingzoos_own_test_finds_no_fault(recwarn):
    parallel_api_test(CreditParallel(Kept(NAMES), credit_for()), num_cycles=20)
    recwarn.clear()


@pytest.mark.parametrize(
    ("environment", "changes", "message"),
    [
        (Toy(NAMES), {"agents": 2}, "the environment has 3 agents, and the assigner has agents = 2"),
        (
            Toy(NAMES, actions={"a_0": spaces.Discrete(3), "a_1": spaces.Discrete(2), "a_2": spaces.Discrete(3)}),
            {},
            "the agents of a team must have the same action space, and 'a_1' has another one than 'a_0'",
        ),
        (
            Toy(NAMES),
            {"observation_space": 7},
            "observations of the environment are rows of 2 numbers, and the assigner was made for 7",
        ),
    ],
)
def test_what_does_not_fit_is_refused(environment, changes, message):
    with pytest.raises(LareError) as refused:
        CreditParallel(environment, credit_for(**changes))
    assert str(refused.value) == message
