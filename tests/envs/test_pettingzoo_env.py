"""PettingZoo environments as HostEnvs: real ones played at random, and a toy that is spoilt in every way."""

import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, Graph, MultiBinary, MultiDiscrete, Tuple
from hypothesis import given
from hypothesis import strategies as st
from pettingzoo.test import parallel_api_test

from helpers.parallel_toys import Toy
from helpers.toys import toy_spec
from lare_rl.envs import agent_arrays as rows_of
from lare_rl.envs.families import make_env
from lare_rl.envs.interface import Team
from lare_rl.envs.load import load_task
from lare_rl.envs.pettingzoo_env import ParallelHost, make
from lare_rl.errors import LareError
from lare_rl.tasks.spec import TaskSpec

SPREAD = "pettingzoo/mpe2.simple_spread_v3:parallel_env"
ADVERSARY = "pettingzoo/mpe2.simple_adversary_v3:parallel_env"
WALKERS = "pettingzoo/pettingzoo.sisl.multiwalker_v9:parallel_env"
KNIGHTS = "pettingzoo/pettingzoo.butterfly.knights_archers_zombies_v11:parallel_env"
TOY = "pettingzoo/helpers.parallel_toys:Toy"


def task(environment=TOY, observation_size=2, action_size=3, **changes) -> TaskSpec:
    sizes = {"observation_size": observation_size, "action_size": action_size}
    return toy_spec(name="toy", environment=environment, **sizes, **changes)


def host(toy=None, **changes) -> ParallelHost:
    return ParallelHost(toy or Toy(), task(**changes))


def still(made: ParallelHost) -> np.ndarray:
    """The first choice of everyone, or the middle of the bounds."""
    if made.spec.discrete:
        return np.eye(made.spec.action_size, dtype=np.float32)[[0] * made.spec.agents]
    return (made.spec.low + made.spec.high) / 2


def at_random(made: ParallelHost, step, chance) -> np.ndarray:
    if made.spec.discrete:
        chosen = [chance.choice(np.flatnonzero(row)) for row in step.available]
        return np.eye(made.spec.action_size, dtype=np.float32)[chosen]
    return chance.uniform(made.spec.low, made.spec.high).astype(np.float32)


def episode(made: ParallelHost, seed: int):
    chance, steps = np.random.default_rng(seed), [made.reset(seed)]
    while not (steps[-1].terminated or steps[-1].truncated):
        steps.append(made.step(at_random(made, steps[-1], chance)))
    return steps


def holds(made: ParallelHost, steps) -> None:
    """What is true of every episode."""
    spec = made.spec
    shapes = {
        "observation": (spec.agents, spec.observation_size),
        "state": (spec.state_size,),
        "available": (spec.agents, spec.action_size),
        "alive": (spec.agents,),
        "reward": (spec.agents,),
        "terminated": (),
        "truncated": (),
    }
    before = np.zeros(spec.agents, bool)
    left = np.zeros(spec.agents, bool)
    for number, step in enumerate(steps):
        for name, shape in shapes.items():
            assert getattr(step, name).shape == shape, name
        for numbers in (step.observation, step.state, step.reward):
            assert numbers.dtype == np.float32
            assert np.isfinite(numbers).all()
        assert step.available.any(-1).all()
        assert not step.observation[~step.alive].any()
        assert not step.reward[~before].any()
        assert not (step.alive & left).any()
        if spec.discrete:
            np.testing.assert_array_equal(step.available[~step.alive].nonzero()[1], 0)
        else:
            assert step.available.all()
        left |= before & ~step.alive
        before = step.alive
        last = number == len(steps) - 1
        assert bool(step.terminated or step.truncated) == last
        assert not (step.terminated and step.truncated)
        assert step.alive.any()
    assert len(steps) - 1 <= spec.max_steps


@pytest.mark.parametrize(
    ("environment", "arguments", "sizes", "episodes"),
    [
        (SPREAD, {}, (18, 5, 54, 25), 5),
        (SPREAD, {"N": 5, "max_cycles": 7, "continuous_actions": True}, (30, 5, 150, 7), 3),
        (ADVERSARY, {}, (10 + 3, 5, 28, 25), 5),
        (WALKERS, {}, (31, 4, 75, 500), 3),
        (KNIGHTS, {"max_zombies": 20}, (185, 6, 144, 900), 6),
    ],
)
def test_real_environments_played_at_random(environment, arguments, sizes, episodes):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SDL_VIDEODRIVER", "dummy")
        made, anew = (make(task(environment, *sizes[:2], arguments=arguments)) for _ in range(2))
        spec = made.spec
        assert (spec.observation_size, spec.action_size, spec.state_size, spec.max_steps) == sizes
        played = [episode(made, seed) for seed in range(episodes)]
        # Knights, Archers, Zombies takes when zombies come into its next episode: anew, it is what it was.
        again = episode(anew if environment == KNIGHTS else made, 0)
        made.close()
        anew.close()
    for steps in played:
        holds(made, steps)
    assert len(again) == len(played[0])
    for one, other in zip(again, played[0], strict=True):
        for left, right in zip(one[:-1], other[:-1], strict=True):
            np.testing.assert_array_equal(left, right)
    assert not np.array_equal(played[0][-1].state, played[1][-1].state)
    if environment == SPREAD:
        assert all(len(steps) == sizes[3] + 1 and steps[-1].truncated for steps in played)
    if environment == KNIGHTS:
        died = [step for steps in played for step in steps if not step.alive.all()]
        assert died, "nobody died"
        assert all(steps[-1].terminated for steps in played)


def test_two_teams_in_their_order():
    roles = [
        task(ADVERSARY, 13, 5).model_copy(update=keys)
        for keys in (
            {"name": "good", "team": "good", "agents": ("agent_*",)},
            {"name": "bad", "team": "bad", "agents": ("adversary_0",)},
        )
    ]
    made = make(task(ADVERSARY, 13, 5, teams=roles))
    assert made.spec.teams == (Team("good", 0, 2), Team("bad", 2, 3))
    first = made.reset(0)
    np.testing.assert_array_equal(first.observation[:, 10:], np.eye(3))
    assert not first.observation[2, 8:10].any()
    assert first.observation[0, 8:10].any()


def test_a_task_file_with_teams(tmp_path):
    for name, agents in (("good", "agent_*"), ("bad", "adversary_*")):
        (tmp_path / f"{name}.toml").write_text(
            f'name = "{name}"\nteam = "{name}"\nagents = ["{agents}"]\nlike = "all.toml"'
        )
    keys = f'environment = "{ADVERSARY}"\nobservation_size = 13\naction_size = 5\n'
    texts = 'description = "d"\nobservation = "o"\naction = "a"\n'
    (tmp_path / "all.toml").write_text(f'name = "all"\n{keys}{texts}')
    (tmp_path / "both.toml").write_text('like = "all.toml"\nname = "both"\nteams = ["good.toml", "bad.toml"]')
    loaded = load_task(tmp_path / "both.toml")
    assert [(role.name, role.agents) for role in loaded.roles] == [("good", ("agent_*",)), ("bad", ("adversary_*",))]
    (tmp_path / "good.toml").write_text(
        'name = "good"\nteam = "good"\nlike = "all.toml"\nobservation_size = 12\nagents = ["agent_*"]'
    )
    with pytest.raises(LareError) as error:
        load_task(tmp_path / "both.toml")
    assert str(error.value) == f"task 'good': observation_size = 12, but {ADVERSARY} has observations of size 13"


def test_who_leaves_observes_zeros_and_an_end_is_seen():
    toy = Toy(agents=("a_0", "a_1", "a_2"), leaves={"a_0": 2, "a_1": 4})
    made = host(toy)
    steps = [made.reset(7), *(made.step(still(made)) for _ in range(5))]
    assert [step.alive.tolist() for step in steps] == [
        *[[True, True, True]] * 2,
        *[[False, True, True]] * 2,
        *[[False, False, True]] * 2,
    ]
    assert [step.reward.tolist() for step in steps] == [[0] * 3, [1] * 3, [1] * 3, [0, 1, 1], [0, 1, 1], [0, 0, 1]]
    assert steps[-1].truncated
    np.testing.assert_array_equal(steps[-1].observation, [[0, 0], [0, 0], [7, 5]])
    assert list(toy.taken[-1]) == ["a_2"]
    with pytest.raises(LareError, match=f"environment '{TOY}' has no episode under way: reset it before step"):
        made.step(still(made))


@pytest.mark.parametrize(
    ("leaves", "limit", "ends"),
    [
        ({"a_0": 2, "a_1": 2}, None, (2, True, [True, True])),
        ({"a_0": 1, "a_1": 2}, None, (2, True, [False, True])),
        ({}, None, (5, False, [True, True])),
        ({"a_0": 5}, None, (5, False, [False, True])),  # it has come to its end, and the other has not
        ({}, 3, (3, False, [True, True])),
        ({"a_0": 3, "a_1": 3}, 3, (3, True, [True, True])),
        ({"a_0": 3}, 3, (3, False, [False, True])),
    ],
)
def test_how_an_episode_ends(leaves, limit, ends):
    made = host(Toy(leaves=leaves), max_episode_steps=limit)
    steps = episode(made, 0)
    holds(made, steps)
    last = steps[-1]
    assert (len(steps) - 1, bool(last.terminated), last.alive.tolist()) == ends
    assert made.spec.max_steps == (limit or 5)


def test_who_comes_later_is_not_there_before():
    toy = Toy(joins={"a_1": 2})
    steps = episode(host(toy), 0)
    assert [step.alive[1] for step in steps] == [False, False, True, True, True, True]
    assert [step.reward[1] for step in steps] == [0, 0, 0, 1, 1, 1]
    assert [len(actions) for actions in toy.taken] == [1, 1, 2, 2, 2]


def test_an_environment_that_writes_into_one_array_is_kept_as_it_was():
    class Reuses(Toy):
        memory = np.zeros(2, np.float32)

        def seen(self, agent):
            self.memory[:] = self.seed, self.steps
            return self.memory

        def state(self):
            return self.memory

    steps = episode(host(Reuses()), 4)
    assert [step.observation[0].tolist() for step in steps] == [[4, number] for number in range(6)]
    assert [step.state.tolist() for step in steps] == [[4, number] for number in range(6)]


def test_observations_stand_in_for_a_state_where_a_step_is_judged_by_one():
    assert host().spec.state_size == 0
    made = make(task(observation_size=4, action_size=6, judged_from="state"))
    np.testing.assert_array_equal(made.reset(3).state, [3, 0, 3, 0])
    with pytest.raises(LareError) as error:
        make_env(task(observation_size=5, action_size=6, judged_from="state"))
    assert str(error.value) == f"task 'toy': observation_size = 5, but {TOY} has states of size 4"


def test_a_state_that_cannot_be_said_for_a_moment(caplog):
    class Falls(Toy):
        def state(self):
            if self.steps in (2, 3):
                raise AttributeError("no hull")
            return np.full((2, 1), self.steps)

    steps = episode(host(Falls()), 0)
    assert [step.state.tolist() for step in steps] == [[0, 0], [1, 1], [1, 1], [1, 1], [4, 4], [5, 5]]
    said = f"environment '{TOY}' failed in state at step 2 of the episode of seed 0: no hull"
    assert [record.getMessage() for record in caplog.records] == [f"{said}; the previous state is used instead"]
    with pytest.raises(LareError) as error:
        episode(host(Falls(), judged_from="state"), 0)
    assert str(error.value) == said


def test_measures_are_the_mean_over_those_who_tell_them():
    steps = episode(host(measures=("count", "place")), 0)
    assert steps[-1].measures == {"count": 5, "place": 0.5}
    assert steps[2].measures == {"count": 0, "place": 0}
    with pytest.raises(LareError, match="the task measures 'left', but the last step's info has only count, place"):
        episode(host(measures=("left",)), 0)


def test_pixels():
    made = make(task(SPREAD, 18, 5), render_mode="rgb_array")
    made.reset(0)
    assert made.render().shape == (700, 700, 3)
    made.close()
    with pytest.raises(LareError, match=f"environment '{TOY}' failed in render: NotImplementedError"):
        host().render()


def test_the_toy_is_what_pettingzoo_wants():
    parallel_api_test(Toy(), 100)


# Masks


def masked(mask_of):
    """Agents whose observation has a mask beside it; `mask_of(toy)` says which."""
    space = Dict({"observation": Box(-9e9, 9e9, (2,), np.float32), "action_mask": MultiBinary(3)})

    class Masks(Toy):
        def seen(self, agent):
            return {"observation": super().seen(agent), "action_mask": mask_of(self)}

    return Masks(observations=dict.fromkeys(("a_0", "a_1"), space))


def in_info(mask_of, from_step=0):
    class Masks(Toy):
        def reset(self, seed=None, options=None):
            observations, infos = super().reset(seed)
            return observations, {agent: self.told() for agent in infos}

        def step(self, actions):
            *answer, infos = super().step(actions)
            return *answer, {agent: self.told() for agent in infos}

        def told(self):
            return {"action_mask": mask_of(self)} if self.steps >= from_step else {}

    return Masks()


MASKS = [masked, in_info]


@pytest.mark.parametrize("kind", MASKS)
@given(masks=st.lists(st.lists(st.booleans(), min_size=3, max_size=3).filter(any), min_size=6, max_size=6))
def test_masks_are_told(kind, masks):
    made = host(kind(lambda toy: np.array(masks[toy.steps], np.int8)))
    assert made.spec.masks_actions
    assert made.spec.observation_size == 2
    steps = episode(made, 0)
    for step, mask in zip(steps[:-1], masks, strict=False):
        np.testing.assert_array_equal(step.available, [mask, mask])
    assert steps[-1].available.all()  # nothing is chosen any more


@pytest.mark.parametrize("kind", MASKS)
@pytest.mark.parametrize(
    ("mask", "message"),
    [
        ([0, 0, 0], "is all 0, which leaves no choice"),
        ([1, 0], "has the shape (2,), and there are 3 choices"),
        ([1, 0.5, 0], "has 0.5 in it; entries must be 0 or 1"),
        ([1, 2, 0], "has 2 in it; entries must be 0 or 1"),
        ("no", "is 'no', which is not an array of numbers"),
    ],
)
def test_masks_that_are_none(kind, mask, message):
    made = host(kind(lambda toy: mask if toy.steps == 1 else np.ones(3, np.int8)))
    made.reset(0)
    with pytest.raises(LareError) as error:
        made.step(still(made))
    assert (
        str(error.value) == f"environment '{TOY}': the action mask of a_0 at step 1 of the episode of seed 0 {message}"
    )


def test_an_end_may_leave_no_choice():
    made = host(masked(lambda toy: np.full(3, toy.steps < 5)))
    assert episode(made, 0)[-1].available.all()


def test_masks_that_come_late():
    made = host(in_info(lambda toy: [1, 1, 0], from_step=2))
    with pytest.raises(LareError) as error:
        episode(made, 0)
    assert str(error.value) == (
        f"environment '{TOY}' gave a_0 an action mask at step 2 of the episode of seed 0, and had none at its first reset"
    )


# Spaces

boxes = st.builds(
    lambda shape, low, width: Box(low, low + width, tuple(shape), np.float32),
    st.lists(st.integers(1, 3), min_size=1, max_size=3),
    st.floats(-100, 100, width=16),
    st.floats(0.5, 100, width=16),
)
plain = boxes | st.builds(lambda n, start: Discrete(n, start=start), st.integers(1, 5), st.integers(-2, 2))
spaces = st.recursive(
    plain | st.builds(MultiDiscrete, st.lists(st.integers(1, 4), min_size=1, max_size=3)),
    lambda inner: (
        st.dictionaries(st.sampled_from("xyz"), inner, min_size=1, max_size=3).map(Dict)
        | st.lists(inner, min_size=1, max_size=3).map(Tuple)
    ),
    max_leaves=4,
)


@given(space=spaces, seed=st.integers(0, 2**31))
def test_observations_of_every_space_are_flattened_in_gymnasiums_order(space, seed):
    space.seed(seed)
    value = space.sample()
    np.testing.assert_allclose(rows_of.flat(space, value), gymnasium.spaces.flatten(space, value), rtol=1e-6)


@given(observations=st.lists(spaces, min_size=1, max_size=3), actions=st.data())
def test_agents_of_any_spaces_side_by_side(observations, actions):
    """Rows are as wide as the widest; what the environment is given is in its space."""
    names = [f"a_{place}" for place in range(len(observations))]
    discrete = actions.draw(st.booleans())
    kinds = (
        st.builds(lambda n, start: Discrete(n, start=start), st.integers(1, 5), st.integers(-2, 2))
        if discrete
        else boxes
    )
    chosen = [actions.draw(kinds) for _ in names]

    class Sees(Toy):
        def seen(self, agent):
            return self.observations[agent].sample()

    toy = Sees(names, dict(zip(names, observations, strict=True)), dict(zip(names, chosen, strict=True)), cycles=2)
    made = host(toy)
    spec, most = made.spec, max(map(gymnasium.spaces.flatdim, observations))
    number = any(one != observations[0] for one in observations) or any(one != chosen[0] for one in chosen)
    assert spec.observation_size == most + number * len(names)
    assert spec.action_size == max(map(gymnasium.spaces.flatdim, chosen))
    assert spec.discrete == discrete
    assert spec.masks_actions == (discrete and len({int(one.n) for one in chosen}) > 1)
    steps = episode(made, 0)  # the toy asserts that actions are in their spaces
    holds(made, steps)
    for step in steps:
        if number:
            np.testing.assert_array_equal(step.observation[:, most:], np.eye(len(names)))
        if discrete:
            np.testing.assert_array_equal(steps[0].available.sum(1), [one.n for one in chosen])
    if not discrete:
        made.reset(0)
        made.step(np.full((len(names), spec.action_size), 1e6, np.float32))
        for one, space in zip(names, chosen, strict=True):
            np.testing.assert_array_equal(toy.taken[-1][one], space.high)


def test_choices_that_do_not_begin_at_0():
    toy = Toy(actions=dict.fromkeys(("a_0", "a_1"), Discrete(3, start=-1)))
    made = host(toy)
    made.reset(0)
    made.step(np.eye(3, dtype=np.float32)[[2, 0]])
    assert toy.taken[-1] == {"a_0": 1, "a_1": -1}


BOX = Box(-1, 1, (2,), np.float32)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            {"actions": {"a_0": Discrete(3), "a_1": BOX}},
            "the actions of a_0 are Discrete(3) and those of a_1 Box(-1.0, 1.0, (2,), float32): "
            "all agents must have a Discrete space, or all a Box",
        ),
        (
            {"actions": {"a_0": Discrete(3), "a_1": MultiDiscrete([2, 2])}},
            "the action space of a_1 is MultiDiscrete([2 2]), neither a Discrete nor a Box",
        ),
        (
            {"actions": {"a_0": Box(-np.inf, 1, (1,), np.float32), "a_1": BOX}},
            "the actions of a_0 have no bounds: Box(-inf, 1.0, (1,), float32)",
        ),
        (
            {"observations": {"a_0": BOX, "a_1": Graph(BOX, None)}},
            "the observation space of a_1 is Graph(Box(-1.0, 1.0, (2,), float32), None), which is no row of numbers",
        ),
        (
            {
                "observations": dict.fromkeys(
                    ("a_0", "a_1"), Dict({"observation": BOX, "action_mask": MultiBinary(2)})
                ),
                "actions": dict.fromkeys(("a_0", "a_1"), BOX),
            },
            "a_0 has an action mask, but its actions are not discrete: Box(-1.0, 1.0, (2,), float32)",
        ),
    ],
)
def test_spaces_that_cannot_be_trained_on(keys, message):
    with pytest.raises(LareError) as error:
        host(Toy(**keys))
    assert str(error.value) == f"environment '{TOY}': {message}"


# What goes wrong when an environment is made


@pytest.mark.parametrize(
    ("environment", "message"),
    [
        (
            "nowhere:parallel_env",
            "cannot be made: No module named 'nowhere' (a module in this folder is found with PYTHONPATH=.)",
        ),
        ("helpers.parallel_toys:Toi", "cannot be made: helpers.parallel_toys has no 'Toi' (did you mean 'Toy'?)"),
        (
            "helpers.parallel_toys:xx",
            "cannot be made: helpers.parallel_toys has no 'xx'; it has Box, Discrete, AECEnv, ParallelEnv, Toy, ",
        ),
        (
            "helpers.parallel_toys:NUMBER",
            "cannot be made: NUMBER of helpers.parallel_toys is 5, which cannot be called",
        ),
        ("helpers.parallel_toys:raises", "cannot be made: no asset"),
        ("helpers.parallel_toys:leaves", "cannot be made: no window"),
        ("helpers.parallel_toys:nothing", "cannot be made: 3 is no ParallelEnv: it has no possible_agents"),
        (
            "helpers.parallel_toys:Turns",
            "cannot be made: Turns makes an AECEnv, whose agents take turns; name its parallel_env",
        ),
        (
            "mpe2.simple_spread_v3:env",
            "cannot be made: env makes an AECEnv, whose agents take turns; name its parallel_env",
        ),
        ("helpers.toys:Chase", "cannot be made: <helpers.toys.Chase object at "),
        ("parallel_toys", "must say where it is made: pettingzoo/MODULE:NAME, like "),
        (":Toy", "must say where it is made: pettingzoo/MODULE:NAME, like "),
        ("pettingzoo:make", "cannot be made: make() missing 2 required positional arguments: 'env_type' and 'id'"),
    ],
)
def test_an_environment_that_cannot_be_made(environment, message):
    with pytest.raises(LareError) as error:
        make(task(f"pettingzoo/{environment}"))
    assert str(error.value).startswith(f"environment 'pettingzoo/{environment}' {message}")
    assert "\n" not in str(error.value)


def test_pettingzoo_is_an_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pettingzoo", None)
    monkeypatch.delitem(sys.modules, "parallel_toys")
    with pytest.raises(LareError, match=r"\(PettingZoo is an extra: pip install .*\[pettingzoo\]'\)$"):
        make(task())


def test_arguments_are_handed_on():
    assert make(task(arguments={"cycles": 9})).spec.max_steps == 9
    registered = {"env_type": "parallel", "id": "sisl/multiwalker-v9", "n_walkers": 2}
    assert make(task("pettingzoo/pettingzoo:make", 31, 4, arguments=registered)).spec.agents == 2
    with pytest.raises(LareError) as error:
        make(task(SPREAD, 18, 5, arguments={"agents": 3}))
    assert "got an unexpected keyword argument 'agents'" in str(error.value)


def test_a_time_limit_is_needed():
    with pytest.raises(LareError) as error:
        host(Toy(cycles=None))
    assert str(error.value) == (
        f"task 'toy': {TOY} has no time limit, so an episode may never pay; "
        "set max_episode_steps in the task file, to the length of its longest episode or more"
    )


@pytest.mark.parametrize(
    ("teams", "message"),
    [
        ({"x": ("a_*",), "y": ("b_*",)}, "no agent is in y, of the agents a_0, a_1 (x: a_*; y: b_*)"),
        ({"x": ("a_*",), "y": ("*_1",)}, "a_1 is in x and y; each agent must be in one team (x: a_*; y: *_1)"),
        ({"x": ("a_0",), "y": ()}, "a_0 is in x and y; each agent must be in one team (x: a_0; y: all)"),
        ({"x": ("a_0",)}, "a_1 is in no team; each agent must be in one team (x: a_0)"),
    ],
)
def test_every_agent_is_in_one_team(teams, message):
    roles = [task().model_copy(update={"name": name, "team": name, "agents": agents}) for name, agents in teams.items()]
    with pytest.raises(LareError) as error:
        host(teams=roles)
    assert str(error.value) == f"task 'toy': {message}"


def test_a_team_without_a_name_of_its_own():
    assert host().spec.teams == (Team("a", 0, 2),)
    assert host(Toy(agents=("a_0", "b_0"))).spec.teams == (Team("agent", 0, 2),)


# What goes wrong later


def without(name):
    return lambda values: {agent: value for agent, value in values.items() if agent != name}


def step_with(**changes):
    """A spoilt third step: what each part is changed to."""
    parts = ("observations", "rewards", "terminations", "truncations", "infos")

    def spoil(toy, *answer):
        return tuple(changes.get(part, lambda value: value)(value) for part, value in zip(parts, answer, strict=True))

    return spoil


def gives(value):
    return lambda values: values | {"a_1": value}


def leave(toy, *answer):
    raise SystemExit(0)


def back(toy, *answer):
    toy.agents.append("a_0")
    return answer


PLACE = "at step 3 of the episode of seed 0"
BROKEN = [
    (step_with(observations=without("a_1")), f"gave no observations for a_1 {PLACE}, although it is among its agents"),
    (step_with(rewards=without("a_1")), f"gave no rewards for a_1 {PLACE}, although it is among its agents"),
    (step_with(terminations=without("a_1")), f"gave no terminations for a_1 {PLACE}, although it is among its agents"),
    (step_with(truncations=without("a_1")), f"gave no truncations for a_1 {PLACE}, although it is among its agents"),
    (
        step_with(observations=lambda values: values | {"z": 0}),
        f"has 'z' among its observations {PLACE}, but its possible agents are a_0, a_1",
    ),
    (
        step_with(rewards=lambda values: values | {"z": 0}),
        f"has 'z' among its rewards {PLACE}, but its possible agents are a_0, a_1",
    ),
    (step_with(rewards=lambda values: 1.0), f"returned 1.0 for its rewards {PLACE}, not a dictionary by agent"),
    (step_with(rewards=gives(np.nan)), f"gave a_1 the reward nan {PLACE}"),
    (step_with(rewards=gives(None)), "gave a_1 the reward None, which is no number"),
    (
        step_with(terminations=gives(np.zeros(2))),
        f"gave array([0., 0.]) for the termination of a_1 {PLACE}, which is not a truth value",
    ),
    (lambda *_: (1, 2, 3), f"returned (1, 2, 3) {PLACE}, not observations, rewards, terminations, truncations, infos"),
    (leave, "failed in step: 0"),
    (lambda *_: 1 / 0, "failed in step: division by zero"),
    (step_with(observations=gives([0, np.nan])), f": the observation of a_1 {PLACE} has nan in it"),
    (step_with(observations=gives([0, 1e300])), f": the observation of a_1 {PLACE} has inf in it"),
    (step_with(observations=gives([0, 1, 2])), f": the observation of a_1 {PLACE} has the shape (3,), not (2,)"),
    (step_with(observations=gives(None)), f": the observation of a_1 {PLACE} has the shape (), not (2,)"),
    (
        step_with(observations=gives("left")),
        f": the observation of a_1 {PLACE} is 'left', which is not an array of numbers",
    ),
    (
        step_with(infos=gives({"action_mask": [1, 1, 1]})),
        f"gave a_1 an action mask {PLACE}, and had none at its first reset",
    ),
]


@pytest.mark.parametrize(("spoil", "message"), BROKEN)
def test_what_cannot_be_learned_from_is_said(spoil, message):
    made = host(Toy(spoil=spoil))
    with pytest.raises(LareError) as error:
        episode(made, 0)
    assert str(error.value) == f"environment '{TOY}'{message if message.startswith(':') else ' ' + message}"


def test_nobody_comes_back():
    made = host(Toy(leaves={"a_0": 2}, spoil=back))
    with pytest.raises(LareError) as error:
        episode(made, 0)
    assert str(error.value) == f"environment '{TOY}' brought back a_0, which had left, {PLACE}"


def test_who_has_left_may_still_be_listed():
    """PettingZoo asks environments to strike them out; not all do."""

    class Keeps(Toy):
        def step(self, actions):
            self.agents = [agent for agent in self.agents if agent in actions]
            answer = super().step(actions)
            self.agents = list(self.possible_agents)
            return answer

    toy = Keeps(leaves={"a_0": 2})
    steps = episode(host(toy), 0)
    holds(host(Keeps(leaves={"a_0": 2})), steps)
    assert [len(actions) for actions in toy.taken] == [2, 2, 1, 1, 1]
    assert [step.alive[0] for step in steps] == [True, True, False, False, False, False]


def reset_late(change):
    """Spoils every reset but the first, which is made to look at the environment."""

    def spoil(toy, observations, infos):
        toy.resets = getattr(toy, "resets", 0) + 1
        return change(toy, observations, infos) if toy.resets > 1 else (observations, infos)

    return spoil


def nobody(toy, observations, infos):
    toy.agents = []
    return observations, infos


def stranger(toy, observations, infos):
    toy.agents = ["a_0", "z"]
    return observations, infos


START = "at the start of the episode of seed 7"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (nobody, f"has no agents {START}"),
        (stranger, f"has 'z' among its agents {START}, but its possible agents are a_0, a_1"),
        (
            lambda toy, o, i: o,
            f"returned {{'a_0': array([7., 0.], dtype=float32), 'a_1': array([7., 0.], dtype=float32)}} {START}, "
            "not observations, infos",
        ),
        (lambda toy, o, i: ({}, i), f"gave no observations for a_0 {START}, although it is among its agents"),
        (lambda *_: 1 / 0, "failed in reset: division by zero"),
    ],
)
def test_a_reset_that_is_none(change, message):
    made = host(Toy(spoil_reset=reset_late(change)))
    with pytest.raises(LareError) as error:
        made.reset(7)
    assert str(error.value) == f"environment '{TOY}' {message}"


def test_what_training_was_set_up_for_may_not_change():
    toy = Toy()
    made = host(toy)
    made.reset(0)
    toy.actions["a_1"] = Discrete(4)
    with pytest.raises(LareError) as error:
        made.reset(1)
    assert (
        str(error.value) == f"environment '{TOY}' has changed the action space of a_1 from Discrete(3) to Discrete(4)"
    )
    toy.actions["a_1"] = Discrete(3)
    toy.possible_agents.append("z")
    with pytest.raises(LareError) as error:
        made.reset(1)
    assert str(error.value) == (
        f"environment '{TOY}' has changed its possible agents from ['a_0', 'a_1'] to ['a_0', 'a_1', 'z']"
    )


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ([0, np.inf], "has inf in it"),
        ([0, 1, 2], "has the shape (3,), not (2,)"),
        ("somewhere", "is 'somewhere', which is not an array of numbers"),
    ],
)
def test_a_state_that_is_none(state, message):
    class Says(Toy):
        def state(self):
            return state if self.steps == 3 else [0, 1]

    with pytest.raises(LareError) as error:
        episode(host(Says()), 0)
    assert str(error.value) == f"environment '{TOY}': the state {PLACE} {message}"


@pytest.mark.parametrize("names", [[], ["a", "a"]])
def test_agents_need_names(names):
    toy = Toy()
    toy.possible_agents = names
    with pytest.raises(LareError) as error:
        host(toy)
    assert str(error.value) == f"environment '{TOY}' has the possible agents {names}: each needs a name"
