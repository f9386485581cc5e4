"""Gymnasium environments as HostEnvs: real ones are what Gymnasium plays, and what a spoilt one gives is refused."""

import contextlib
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, Graph, MultiDiscrete
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from helpers.toys import Chase, toy_spec
from lare_rl.envs.guarded_gymnasium import EnvironmentFault
from lare_rl.envs.gymnasium_env import GymnasiumEnv, checked
from lare_rl.envs.interface import Team
from lare_rl.errors import LareError


def known(name: str, maker: Any, **options: Any) -> None:
    gymnasium.register(f"foreign/{name}-v0", entry_point=maker, max_episode_steps=20, **options)


STILL = np.zeros((1, 1), np.float32)


class Spoilt(Chase):
    """Gives something else at its second step, or instead of all that `reset` returns."""

    def __init__(self, **parts):
        super().__init__()
        self.parts, self.steps = parts, 0

    def reset(self, *, seed=None, options=None):
        answer = super().reset(seed=seed)
        return self.parts.get("reset", answer)

    def step(self, action) -> Any:
        answer = dict(
            zip(("observation", "reward", "terminated", "truncated", "info"), super().step(action), strict=True)
        )
        self.steps += 1
        return tuple((answer | self.parts if self.steps == 2 else answer)[key] for key in answer)


class Reuses(Chase):
    """Writes every observation into the same memory, as simulators do."""

    memory = np.zeros(2, np.float32)

    def observe(self):
        self.memory += 1
        self.state = np.zeros(2)
        return self.memory


class OutOfItsSpace(Chase):
    observation_space = Discrete(4)

    def observe(self) -> Any:
        super().observe()
        return 7


class Precise(Chase):
    action_space = Box(np.array([1 / 3], np.float64), np.array([2 / 3], np.float64), dtype=np.float64)


class Whole(Chase):
    action_space = Box(-3, 3, (1,), np.int8)


# Gymnasium's own checker looks at the first step, and would say some of it first.
for name, maker in (("Spoilt", Spoilt), ("Reuses", Reuses), ("OutOfItsSpace", OutOfItsSpace)):
    known(name, maker, disable_env_checker=True)
for name, maker in (("Precise", Precise), ("Whole", Whole)):
    known(name, maker)


def spoilt(*, measures=(), **parts) -> GymnasiumEnv:
    return GymnasiumEnv(toy_spec(environment="foreign/Spoilt-v0", measures=measures), **parts)


@pytest.mark.parametrize(
    ("environment", "sizes", "low", "high"),
    [
        ("Pendulum-v1", (3, 1, False, 200), [-2], [2]),
        ("CartPole-v1", (4, 2, True, 500), [0, 0], [1, 1]),
        ("FrozenLake-v1", (16, 4, True, 100), [0] * 4, [1] * 4),
        ("Blackjack-v1", (45, 2, True, 9), [0, 0], [1, 1]),
        ("Reacher-v5", (10, 2, False, 50), [-1, -1], [1, 1]),
    ],
)
def test_sizes_and_bounds_of_real_environments(environment, sizes, low, high):
    limit = 9 if environment == "Blackjack-v1" else None  # it has none of its own
    with contextlib.closing(GymnasiumEnv(toy_spec(environment=environment, max_episode_steps=limit))) as env:
        spec = env.spec
    assert (spec.observation_size, spec.action_size, spec.discrete, spec.max_steps) == sizes
    assert (spec.low.tolist(), spec.high.tolist()) == ([low], [high])
    assert spec.teams == (Team("agent", 0, 1),)
    assert (spec.state_size, spec.in_jax, spec.fixed_length, spec.agents_leave, spec.masks_actions) == (0, *[False] * 4)


def test_bounds_are_as_precise_as_the_environments():
    """A third in float32 is beyond a third in float64; actions are scaled in floats, also to whole bounds."""
    precise = GymnasiumEnv(toy_spec(environment="foreign/Precise-v0")).spec
    assert (precise.low.dtype, precise.low[0, 0]) == (np.float64, 1 / 3)
    whole = GymnasiumEnv(toy_spec(environment="foreign/Whole-v0")).spec
    assert (whole.low.dtype, whole.low[0, 0]) == (np.float32, -3)


@pytest.mark.parametrize("environment", ["Pendulum-v1", "CartPole-v1"])
def test_an_episode_is_the_one_that_gymnasium_plays(environment):
    task = toy_spec(environment=environment, max_episode_steps=40)
    env, other = GymnasiumEnv(task), gymnasium.make(environment, max_episode_steps=40)
    random, spec = np.random.default_rng(0), env.spec
    shown, (observation, _) = env.reset(11), other.reset(seed=11)
    np.testing.assert_array_equal(shown.observation, observation[None])
    assert shown.reward.tolist() == [0]
    steps, ended = 0, False
    while not ended:
        number = random.integers(2)
        action = np.eye(2, dtype=np.float32)[[number]] if spec.discrete else np.array([[number]], np.float32)
        shown, steps = env.step(action), steps + 1
        observation, reward, terminated, truncated, _ = other.step(number if spec.discrete else action[0])
        np.testing.assert_array_equal(shown.observation, observation[None])
        np.testing.assert_array_equal(shown.reward, np.array([reward], np.float32))
        assert (shown.terminated, shown.truncated) == (terminated, truncated)
        assert (shown.alive.tolist(), shown.available.tolist()) == ([True], [[True] * spec.action_size])
        assert (shown.state.shape, shown.measures) == ((0,), {})
        ended = terminated or truncated
    env.close()
    other.close()
    # The pole falls by then; the pendulum has time until the end.
    assert (steps == 40, bool(shown.terminated)) == ((True, False) if environment == "Pendulum-v1" else (False, True))


def test_what_was_seen_stays_when_the_environment_writes_the_next():
    env = GymnasiumEnv(toy_spec(environment="foreign/Reuses-v0"))
    steps = [env.reset(0), env.step(STILL), env.step(STILL)]
    first = steps[0].observation[0, 0]
    assert [step.observation.tolist() for step in steps] == [[[first + number] * 2] for number in range(3)]


def test_measures_are_of_the_last_step():
    """At another step nobody asks, so that `info` need not tell them there."""
    env = GymnasiumEnv(toy_spec(measures=("distance",), max_episode_steps=2))
    assert env.spec.measures == ("distance",)
    first, middle = env.reset(0), env.step(STILL)
    last = env.step(STILL)
    target = last.observation[0, 0]
    assert (first.measures, middle.measures) == ({"distance": 0}, {"distance": 0})
    assert last.measures == {"distance": abs(target)}
    assert target != 0


@pytest.mark.parametrize(
    ("info", "message"),
    [
        ({}, "the task measures 'won', but the last step's info is empty (was the episode cut at max_episode_steps?)"),
        ({"lost": 1, 3: 4}, "the task measures 'won', but the last step's info has only 3, lost"),
        ({"won": "yes"}, "the task measures 'won', and the last step's info has 'yes', which is no number"),
        ({"won": 10**400}, f"the task measures 'won', and the last step's info has 1{'0' * 99}..., which is no number"),
    ],
)
def test_a_measure_that_is_not_told(info, message):
    env = spoilt(info=info, terminated=True, measures=("won",))
    env.reset(0)
    env.step(STILL)
    with pytest.raises(LareError) as error:
        env.step(STILL)
    assert str(error.value) == message


# What nothing can be learned from.


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"observation": np.array([0, np.nan], np.float32)}, "the environment gave nan in its observation"),
        ({"observation": [0, -np.inf]}, "the environment gave -inf in its observation"),
        ({"observation": np.array([0, 1e300], np.float64)}, "the environment gave inf in its observation"),
        ({"observation": [0, 10**400]}, f"the environment gave [0, 1{'0' * 95}... for its observation"),
        ({"observation": np.zeros(3)}, "the environment gave its observation in shape (3,), not (2,)"),
        ({"observation": np.zeros((1, 2))}, "the environment gave its observation in shape (1, 2), not (2,)"),
        ({"observation": 0.5}, "the environment gave its observation in shape (), not (2,)"),
        ({"observation": None}, "the environment gave its observation in shape (), not (2,)"),
        ({"observation": ["a", "b"]}, "the environment gave ['a', 'b'] for its observation"),
        ({"observation": [[0], [0, 1]]}, "the environment gave [[0], [0, 1]] for its observation"),
        ({"observation": {"x": 0}}, "the environment gave {'x': 0} for its observation"),
        ({"info": None}, "environment 'foreign/Spoilt-v0' gave None for its info, which is no dictionary"),
        ({"reward": np.nan}, "the environment gave nan in its reward"),
        ({"reward": 1e39}, "the environment gave inf in its reward"),
        (
            {"reward": 10**400},
            f"environment 'foreign/Spoilt-v0' gave the reward 1{'0' * 99}..., which is no number",
        ),
        ({"reward": "much"}, "environment 'foreign/Spoilt-v0' gave the reward 'much', which is no number"),
        (
            {"terminated": np.array([True, False])},
            "environment 'foreign/Spoilt-v0' failed in step: "
            "The truth value of an array with more than one element is ambiguous. Use a.any() or a.all()",
        ),
    ],
)
def test_what_cannot_be_learned_from_is_said(parts, message):
    env = spoilt(**parts)
    env.reset(0)
    env.step(STILL)
    with pytest.raises(LareError) as error:
        env.step(STILL)
    assert str(error.value) == message


@pytest.mark.parametrize(
    ("environment", "parts", "message"),
    [
        # A bare observation, as before Gymnasium: of 3 numbers, and of 2, which look like observation and info.
        (
            "Spoilt",
            {"reset": np.zeros(3)},
            "environment 'foreign/Spoilt-v0' failed in reset: too many values to unpack (expected 2)",
        ),
        (
            "Spoilt",
            {"reset": [0.5, 0.25]},
            "environment 'foreign/Spoilt-v0' gave 0.25 for its info, which is no dictionary",
        ),
        (
            "OutOfItsSpace",
            {},
            "environment 'foreign/OutOfItsSpace-v0' failed in reset: index 7 is out of bounds for axis 0 with size 4",
        ),
    ],
)
def test_a_start_that_is_none(environment, parts, message):
    env = GymnasiumEnv(toy_spec(environment=f"foreign/{environment}-v0"), **parts)
    with pytest.raises(LareError) as error:
        env.reset(0)
    # How Python says it has changed: newer ones add how many values there were.
    assert str(error.value).replace(", got 3)", ")") == message


numbers = st.floats(width=64) | st.integers() | st.booleans() | st.none() | st.text(max_size=3)
foreign = (
    st.recursive(numbers, lambda inner: st.lists(inner, max_size=3), max_leaves=4)
    | st.dictionaries(st.integers(0, 2), numbers, max_size=2)
    | arrays.arrays(np.float64, arrays.array_shapes(min_dims=0, max_dims=2, max_side=3))
    | arrays.arrays(np.int64, (2,))
    | st.integers(min_value=2**1024)
    | st.complex_numbers()
    | st.binary(max_size=4)
)


@given(value=foreign, shape=st.sampled_from([(), (1,), (2,)]))
def test_whatever_is_given_is_numbers_of_its_shape_or_a_fault_of_one_line(value, shape):
    try:
        array = checked(value, "observation", shape)
    except EnvironmentFault as error:
        assert str(error).startswith("the environment gave ")  # noqa: PT017
        assert "\n" not in str(error)  # noqa: PT017
    else:
        assert (array.shape, array.dtype) == (shape, np.float32)
        assert np.isfinite(array).all()


@given(value=arrays.arrays(np.float64, (2,), elements=st.floats(-1e30, 1e30)))
def test_numbers_come_through_as_they_are(value):
    np.testing.assert_array_equal(checked(value, "observation", (2,)), value.astype(np.float32))


# What is refused before the first step. (`test_spec.py` has what spaces of actions are.)


@pytest.mark.parametrize(
    ("space", "said"),
    [
        (Graph(Box(-1, 1, (2,)), None), "Graph(Box(-1.0, 1.0, (2,), float32), None)"),
        (
            Dict({"net": Graph(Box(-1, 1, (2,)), None)}),
            "Dict('net': Graph(Box(-1.0, 1.0, (2,), float32), None))",
        ),
    ],
)
def test_observations_that_are_no_rows_are_refused_and_the_environment_closed(space, said):
    closed = []

    class Shaped(Chase):
        observation_space = space

        def close(self):
            closed.append(True)

    known("Shaped", Shaped)
    try:
        with pytest.raises(LareError) as error:
            GymnasiumEnv(toy_spec(environment="foreign/Shaped-v0"))
    finally:
        del gymnasium.registry["foreign/Shaped-v0"]
    assert (
        str(error.value) == f"task 'Chase': the observation space of foreign/Shaped-v0 is {said}, not a Box of one axis"
    )
    assert closed == [True]


def test_spaces_of_several_axes_and_parts_become_rows():
    class Parts(Chase):
        observation_space = Dict({"grid": Box(0, 9, (2, 2), np.float32), "pick": MultiDiscrete([2, 3])})

        def observe(self) -> Any:
            super().observe()
            return {"grid": np.array([[1, 2], [3, 4]], np.float32), "pick": np.array([1, 2])}

    known("Parts", Parts)
    try:
        env = GymnasiumEnv(toy_spec(environment="foreign/Parts-v0"))
    finally:
        del gymnasium.registry["foreign/Parts-v0"]
    assert env.reset(0).observation.tolist() == [[1, 2, 3, 4, 0, 1, 0, 0, 1]]


def test_pixels_where_they_are_asked_for():
    with contextlib.closing(GymnasiumEnv(toy_spec(environment="FrozenLake-v1"), render_mode="ansi")) as env:
        env.reset(0)
        assert "SFFF" in env.render().replace("\x1b[41mS\x1b[0m", "S")
