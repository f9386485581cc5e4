"""PettingZoo environments as HostEnvs: real ones under random actions, and a toy that returns invalid values."""

import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.long_tests import long_case
from helpers.parallel_toy_envs import Toy
from helpers.toy_envs import toy_spec
from lare_rl.envs.pettingzoo_env import ParallelHost, make
from lare_rl.envs.play import play_steps
from lare_rl.errors import LareError
from lare_rl.tasks.spec import TaskSpec

SPREAD = "pettingzoo/mpe2.simple_spread_v3:parallel_env"
ADVERSARY = "pettingzoo/mpe2.simple_adversary_v3:parallel_env"
WALKERS = "pettingzoo/pettingzoo.sisl.multiwalker_v9:parallel_env"
KNIGHTS = "pettingzoo/pettingzoo.butterfly.knights_archers_zombies_v11:parallel_env"
TOY = "pettingzoo/helpers.parallel_toy_envs:Toy"


def make_task(environment=TOY, observation_size=2, action_size=3, **changes) -> TaskSpec:
    sizes = {"observation_size": observation_size, "action_size": action_size}
    return toy_spec(name="toy", environment=environment, **sizes, **changes)


def make_host(toy=None, **changes) -> ParallelHost:
    return ParallelHost(toy or Toy(), make_task(**changes))


def first_actions(host: ParallelHost) -> np.ndarray:
    return np.eye(host.spec.action_size, dtype=np.float32)[[0] * host.spec.n_agents]


def play(host: ParallelHost, seed: int = 0):
    """All timesteps of an episode under random actions."""
    steps = list(play_steps(host, None, np.random.default_rng(seed), seed))
    return [steps[0][0], *(next_timestep for *_, next_timestep in steps)]


def check_episode(host: ParallelHost, timesteps) -> None:
    """Assert what the interface promises for every episode."""
    spec, agents = host.spec, host.spec.n_agents
    shapes = [(agents, spec.observation_size), (spec.state_size,), (agents, spec.action_size), *[(agents,)] * 2, (), ()]
    was_alive, departed = np.zeros((2, agents), bool)
    for number, timestep in enumerate(timesteps):
        assert [value.shape for value in timestep[:-1]] == shapes
        for values in (timestep.observation, timestep.state, timestep.reward):
            assert values.dtype == np.float32
            assert np.isfinite(values).all()
        assert timestep.available.any(-1).all()
        assert not timestep.observation[~timestep.alive].any()
        assert not timestep.reward[~was_alive].any()
        assert not (timestep.alive & departed).any()
        assert timestep.alive.any()
        if spec.discrete:
            np.testing.assert_array_equal(timestep.available[~timestep.alive].nonzero()[1], 0)
        else:
            assert timestep.available.all()
        departed |= was_alive & ~timestep.alive
        was_alive = timestep.alive
        assert bool(timestep.terminated or timestep.truncated) == (number == len(timesteps) - 1)
        assert not (timestep.terminated and timestep.truncated)
    assert len(timesteps) - 1 <= spec.max_steps


@pytest.mark.parametrize(
    ("environment", "arguments", "sizes", "n_episodes"),
    [
        (SPREAD, {"N": 5, "max_cycles": 7, "continuous_actions": True}, (30, 5, 150, 7), 2),
        (ADVERSARY, {}, (10 + 3, 5, 28, 25), 2),
        (WALKERS, {}, (31, 4, 75, 500), 2),
        long_case(KNIGHTS, {"max_zombies": 20}, (185, 6, 144, 900), 2),
    ],
)
def test_real_environments(environment, arguments, sizes, n_episodes, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    host, second = (make(make_task(environment, *sizes[:2], arguments=arguments)) for _ in range(2))
    spec = host.spec
    assert (spec.observation_size, spec.action_size, spec.state_size, spec.max_steps) == sizes
    episodes = [play(host, seed) for seed in range(n_episodes)]
    # Knights, Archers, Zombies carries the times of zombies over to the next episode. A new one is reproducible.
    repeated = play(second if environment == KNIGHTS else host, 0)
    host.close()
    second.close()
    for timesteps in episodes:
        check_episode(host, timesteps)
    assert len(repeated) == len(episodes[0])
    for repeat, timestep in zip(repeated, episodes[0], strict=True):
        for values, expected in zip(repeat[:-1], timestep[:-1], strict=True):
            np.testing.assert_array_equal(values, expected)
    assert not np.array_equal(episodes[0][-1].state, episodes[1][-1].state)
    if environment == SPREAD:
        assert all(len(timesteps) == sizes[3] + 1 and timesteps[-1].truncated for timesteps in episodes)
    if environment == KNIGHTS:
        assert not all(timestep.alive.all() for timesteps in episodes for timestep in timesteps)
        assert all(timesteps[-1].terminated for timesteps in episodes)


# Episodes


def test_agents_that_leave():
    toy = Toy(agents=("a_0", "a_1", "a_2"), leaves={"a_0": 2, "a_1": 4})
    host = make_host(toy)
    timesteps = [host.reset(7), *(host.step(first_actions(host)) for _ in range(5))]
    alive, reward = (np.array([getattr(timestep, name) for timestep in timesteps]) for name in ("alive", "reward"))
    np.testing.assert_array_equal(alive.T, [[1, 1, 0, 0, 0, 0], [1, 1, 1, 1, 0, 0], [1, 1, 1, 1, 1, 1]])
    np.testing.assert_array_equal(reward.T, [[0, 1, 1, 0, 0, 0], [0, 1, 1, 1, 1, 0], [0, 1, 1, 1, 1, 1]])
    assert timesteps[-1].truncated
    np.testing.assert_array_equal(timesteps[-1].observation, [[0, 0], [0, 0], [7, 5]])
    assert list(toy.received_actions[-1]) == ["a_2"]
    with pytest.raises(LareError, match="reset before step"):
        host.step(first_actions(host))


@pytest.mark.parametrize(
    ("leaves", "limit", "end"),
    [
        ({"a_0": 1, "a_1": 2}, None, (2, True, [False, True])),
        ({}, None, (5, False, [True, True])),
        ({"a_0": 5}, None, (5, False, [False, True])),  # terminated, while the other agent is truncated
        ({}, 3, (3, False, [True, True])),
        ({"a_0": 3, "a_1": 3}, 3, (3, True, [True, True])),  # both leave at the limit
        ({"a_0": 3}, 3, (3, False, [False, True])),
    ],
)
def test_ends_of_episodes(leaves, limit, end):
    host = make_host(Toy(leaves=leaves), max_episode_steps=limit)
    timesteps = play(host)
    check_episode(host, timesteps)
    last = timesteps[-1]
    assert (len(timesteps) - 1, bool(last.terminated), last.alive.tolist()) == end
    assert host.spec.max_steps == (limit or 5)


def test_agents_that_join_and_that_left_but_are_listed():
    """PettingZoo asks environments to remove agents that left, but some do not."""

    class Keeps(Toy):
        def step(self, actions):
            self.agents = [agent for agent in self.agents if agent in actions]
            results = super().step(actions)
            self.agents = list(self.possible_agents)
            return results

    toy = Toy(joins={"a_1": 2})
    timesteps = play(make_host(toy))
    assert [timestep.alive[1] for timestep in timesteps] == [False, False, True, True, True, True]
    assert [timestep.reward[1] for timestep in timesteps] == [0, 0, 0, 1, 1, 1]
    assert [len(actions) for actions in toy.received_actions] == [1, 1, 2, 2, 2]
    toy = Keeps(leaves={"a_0": 2})
    assert [timestep.alive[0] for timestep in play(make_host(toy))] == [True, True, False, False, False, False]
    assert [len(actions) for actions in toy.received_actions] == [2, 2, 1, 1, 1]


def test_missing_and_failed_states(caplog):
    """Observations replace a missing state, and the previous state one that failed."""

    class Falls(Toy):
        def state(self):
            if self.steps in (2, 3):
                raise AttributeError("no hull")
            return np.full((2, 1), self.steps)

    assert make_host().spec.state_size == 0
    host = make(make_task(observation_size=4, action_size=6, credit_scope="state"))
    np.testing.assert_array_equal(host.reset(3).state, [3, 0, 3, 0])
    timesteps = play(make_host(Falls()))
    assert [timestep.state.tolist() for timestep in timesteps] == [[0, 0], [1, 1], [1, 1], [1, 1], [4, 4], [5, 5]]
    (record,) = caplog.records
    assert "no hull" in record.getMessage()
    with pytest.raises(LareError, match="no hull"):
        play(make_host(Falls(), credit_scope="state"))


def test_measures_are_means_over_agents():
    timesteps = play(make_host(measures=("count", "place")))
    assert timesteps[-1].measures == {"count": 5, "place": 0.5}
    assert timesteps[2].measures == {"count": 0, "place": 0}
    with pytest.raises(LareError, match=r"'left', but .* has only count, place"):
        play(make_host(measures=("left",)))


# Masks


def masked_toy(make_mask, in_info=True) -> Toy:
    """Agents that find `make_mask(toy)` in `info`, or in a dictionary with their observation."""

    class Masks(Toy):
        def observe(self, agent):
            observation = super().observe(agent)
            return observation if in_info else {"observation": observation, "action_mask": make_mask(self)}

        def reset(self, seed=None, options=None):
            observations, infos = super().reset(seed)
            return observations, self.make_infos(infos)

        def step(self, actions):
            *results, infos = super().step(actions)
            return *results, self.make_infos(infos)

        def make_infos(self, infos):
            return {agent: {"action_mask": make_mask(self)} if in_info else {} for agent in infos}

    space = Dict({"observation": Box(-9e9, 9e9, (2,), np.float32), "action_mask": MultiBinary(3)})
    return Masks(observations=None if in_info else dict.fromkeys(("a_0", "a_1"), space))


@pytest.mark.parametrize("in_info", [False, True])
@settings(deadline=None, max_examples=10)
@given(masks=st.lists(st.lists(st.booleans(), min_size=3, max_size=3).filter(any), min_size=5, max_size=5))
def test_masks(in_info, masks):
    """The last observation has a mask without actions, which nobody reads."""
    masks = [*masks, [False] * 3]
    host = make_host(masked_toy(lambda toy: np.array(masks[toy.steps], np.int8), in_info))
    assert host.spec.masks_actions
    assert host.spec.observation_size == 2
    timesteps = play(host)
    for timestep, mask in zip(timesteps[:-1], masks, strict=False):
        np.testing.assert_array_equal(timestep.available, [mask, mask])
    assert timesteps[-1].available.all()


# Spaces


@settings(deadline=None, max_examples=40)
@given(data=st.data(), sizes=st.lists(st.integers(1, 3), min_size=1, max_size=3), discrete=st.booleans())
def test_agents_with_different_spaces(data, sizes, discrete):
    names = [f"a_{index}" for index in range(len(sizes))]
    observations = [Box(-1, 1, (size,), np.float32) for size in sizes]
    kinds = (
        st.builds(lambda n, start: Discrete(n, start=start), st.integers(1, 5), st.integers(-2, 2))
        if discrete
        else st.builds(lambda n, low: Box(low, low + 2, (n, 1), np.float32), st.integers(1, 3), st.integers(-9, 9))
    )
    actions = [data.draw(kinds) for _ in names]

    class Samples(Toy):
        def observe(self, agent):
            return self.observations[agent].sample()

    toy = Samples(names, dict(zip(names, observations, strict=True)), dict(zip(names, actions, strict=True)), cycles=2)
    host = make_host(toy)
    spec, adds_index = host.spec, len(set(sizes)) > 1 or any(action != actions[0] for action in actions)
    assert spec.observation_size == max(sizes) + adds_index * len(names)
    assert spec.action_size == max(map(gymnasium.spaces.flatdim, actions))
    assert spec.discrete == discrete
    assert spec.masks_actions == (discrete and len({int(action.n) for action in actions}) > 1)
    timesteps = play(host)  # the toy asserts that actions are in their spaces
    check_episode(host, timesteps)
    if adds_index:
        np.testing.assert_array_equal(timesteps[1].observation[:, max(sizes) :], np.eye(len(names)))
    for observation, size in zip(timesteps[1].observation, sizes, strict=True):
        assert not observation[size : max(sizes)].any()
    if discrete:
        np.testing.assert_array_equal(timesteps[0].available.sum(1), [action.n for action in actions])
    else:
        host.reset(0)
        host.step(np.full((len(names), spec.action_size), 1e6, np.float32))
        for name, space, high in zip(names, actions, spec.high, strict=True):
            np.testing.assert_array_equal(toy.received_actions[-1][name], space.high)
            np.testing.assert_array_equal(high, np.pad(space.high.ravel(), (0, len(high) - space.high.size)))


# Errors when an environment is made


@pytest.mark.parametrize(
    ("environment", "content"),
    [
        ("nowhere:parallel_env", r"No module named 'nowhere' .*PYTHONPATH"),
        ("helpers.parallel_toy_envs:Toi", "did you mean 'Toy'"),
        ("helpers.parallel_toy_envs:raises", "no asset track.bin$"),
        ("mpe2.simple_spread_v3:env", "AECEnv"),
        (":Toy", "MODULE:NAME"),
    ],
)
def test_environment_that_cannot_be_made(environment, content):
    with pytest.raises(LareError, match=content) as error:
        make(make_task(f"pettingzoo/{environment}"))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changes", "content"),
    [
        ({"max_cycles": None}, "no time limit"),
        ({"actions": dict.fromkeys(("a_0", "a_1"), MultiDiscrete([2, 2]))}, f"{TOY}.*action space of a_0"),
        ({"possible_agents": ["a_0", "b_0"]}, "spaces cannot be read: KeyError 'b_0'"),
        ({"spoil_reset": lambda toy, *results: vars(toy).pop("agents") and results}, "its agents cannot be read"),
    ],
)
def test_toy_that_is_refused(changes, content):
    toy = Toy()
    vars(toy).update(changes)
    with pytest.raises(LareError, match=content):
        make_host(toy)


def test_teams_in_another_order_than_their_files_alone():
    """The function of b would be verified on states in which c stands after it."""
    toy = Toy(("a_0", "b_0", "c_0"))

    def make(scope, **patterns):
        keys = {"credit_scope": scope, "observation_size": 6 if scope == "state" else 2}
        sizes = {name: 3 * len(agents) if scope == "state" else 3 for name, agents in patterns.items()}
        roles = [
            make_task(team=name, agents=agents, action_size=sizes[name], **keys) for name, agents in patterns.items()
        ]
        teams = [role.model_copy(update={"name": role.team}) for role in roles]
        return make_host(toy, teams=teams, credit_scope=scope)

    for patterns in ({"x": ("a_*", "c_*"), "b": ("b_*",)}, {"b": ("b_*",), "x": ("a_*", "c_*")}):
        make("observation", **patterns)
        with pytest.raises(LareError, match="List the teams in the order"):
            make("state", **patterns)
    make("state", x=("a_*", "b_*"), c=("c_*",))


# Invalid values later


def change(value, field):
    """A step that returns another value of a_1; without a value, the value is missing."""
    fields = ("observations", "rewards", "terminations", "truncations", "infos")

    def spoil(toy, *results):
        values = {key: value for key, value in results[fields.index(field)].items() if key != "a_1"}
        if value is not None:
            values["a_1"] = value
        return tuple(values if name == field else result for name, result in zip(fields, results, strict=True))

    return spoil


def list_agents(*names):
    def spoil(toy, *results):
        toy.agents = list(names)
        return results

    return spoil


def spoil_later_reset(spoil):
    """A toy whose first reset, by which the host learns its sizes, succeeds. The next one has the seed 7."""
    return Toy(spoil_reset=lambda toy, *results: spoil(toy, *results) if toy.seed == 7 else results)


def change_mask(mask):
    return masked_toy(lambda toy: mask if toy.steps == 3 else np.ones(3, np.int8))


def change_state(state):
    toy = Toy()
    toy.state = lambda: state if toy.steps == 3 else [0, 1]
    return toy


INVALID = {
    "no observation for a_1": Toy(spoil=change(None, "observations")),
    "no reward for a_1": Toy(spoil=change(None, "rewards")),
    "reward of a_1 contains inf": Toy(spoil=change(1e39, "rewards")),
    "termination of a_1 is array": Toy(spoil=change(np.zeros(2), "terminations")),
    "observation of a_1 contains nan in entry 1": Toy(spoil=change([0, np.nan], "observations")),
    "action mask for a_1, but none at its first": Toy(spoil=change({"action_mask": [1, 1, 1]}, "infos")),
    "has the agent 'z'": Toy(spoil=list_agents("a_0", "z")),
    "a_0 is among its agents again": Toy(spoil=list_agents("a_0", "a_1"), leaves={"a_0": 2}),
    "not 5 dictionaries": Toy(spoil=lambda *_: (1, 2, 3)),
    "failed in step: 0": Toy(spoil=lambda *_: sys.exit(0)),
    "no agents after reset": spoil_later_reset(list_agents()),
    "not 2 dictionaries": spoil_later_reset(lambda toy, observations, infos: observations),
    "failed in reset: division": spoil_later_reset(lambda *_: 1 / 0),
    "action mask of a_0 is 0 for all": change_mask([0, 0, 0]),
    "action mask of a_0 has the shape": change_mask([1, 0]),
    "action mask of a_0 contains 0.5": change_mask([1, 0.5, 0]),
    "action mask of a_0 is 'no'": change_mask("no"),
    "the state contains inf in entry 1": change_state([0, np.inf]),
    "the state has the shape": change_state([0, 1, 2]),
    "the state is 'x'": change_state("x"),
}


@pytest.mark.parametrize("content", INVALID)
def test_invalid_values(content):
    with pytest.raises(LareError, match=content) as error:
        play(make_host(INVALID[content]), seed=7)
    assert str(error.value).startswith((f"environment '{TOY}'", "the environment: "))
    assert "\n" not in str(error.value)
