"""Gymnasium environments as HostEnvs: real ones equal Gymnasium, and invalid values of a toy are refused."""

import contextlib
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete

from helpers.toy_envs import Chase, toy_spec
from lare_rl.envs.env_errors import MAX_ERROR, EnvOutputError, check_finite, one_line_errors
from lare_rl.envs.gymnasium_env import GymnasiumEnv, make_gymnasium
from lare_rl.envs.interface import Team
from lare_rl.errors import LareError

STILL = np.zeros((1, 1), np.float32)


class Invalid(Chase):
    """Returns other values at its second step, or from `reset`; or raises `error` in the method `fail_in`."""

    def __init__(self, reset=None, fail_in="", error=None, **values):
        super().__init__()
        self.values, self.reset_result, self.fail_in, self.error, self.steps = values, reset, fail_in, error, 0

    def fail(self, method):
        if self.fail_in == method:
            raise self.error

    def reset(self, *, seed=None, options=None):
        self.fail("reset")
        result = super().reset(seed=seed)
        return result if self.reset_result is None else self.reset_result

    def step(self, action) -> Any:
        names = ("observation", "reward", "terminated", "truncated", "info")
        result = dict(zip(names, super().step(action), strict=True))
        self.steps += 1
        if self.steps == 2:
            self.fail("step")
            result |= self.values
        return tuple(result[name] for name in names)

    def render(self):
        self.fail("render")

    def close(self):
        self.fail("close")


class Reuses(Chase):
    """Writes every observation into the same memory, as simulators do."""

    memory = np.zeros(2, np.float32)

    def observe(self):
        self.memory += 1
        self.state = np.zeros(2)
        return self.memory


class OtherActions(Chase):
    def __init__(self, action_space):
        super().__init__()
        self.action_space = action_space

    def step(self, action):
        assert self.action_space.contains(action)
        return super().step(np.ravel(action)[:1])


for maker in (Invalid, Reuses, OtherActions):
    checks = {"disable_env_checker": maker is not OtherActions}
    gymnasium.register(f"foreign/{maker.__name__}-v0", entry_point=maker, max_episode_steps=20, **checks)


def make_env(name: str, **kwargs) -> GymnasiumEnv:
    return GymnasiumEnv(toy_spec(environment=f"foreign/{name}-v0"), **kwargs)


@pytest.mark.parametrize(
    ("environment", "sizes", "low", "high"),
    [
        ("Pendulum-v1", (3, 1, False, 200), [[-2]], [[2]]),
        ("CartPole-v1", (4, 2, True, 500), [], []),
        ("FrozenLake-v1", (16, 4, True, 100), [], []),
        ("Blackjack-v1", (45, 2, True, 9), [], []),
    ],
)
def test_spec_of_real_environments(environment, sizes, low, high):
    limit = 9 if environment == "Blackjack-v1" else None  # it has no limit of its own
    with contextlib.closing(GymnasiumEnv(toy_spec(environment=environment, max_episode_steps=limit))) as env:
        spec = env.spec
    assert (spec.observation_size, spec.action_size, spec.discrete, spec.max_steps) == sizes
    assert (spec.low.tolist(), spec.high.tolist()) == (low, high)
    assert spec.teams == (Team("agent", 0, 1),)
    assert (spec.state_size, spec.is_jax, spec.fixed_length, spec.agents_leave, spec.masks_actions) == (0, *[False] * 4)


def test_bounds_and_actions_of_spaces():
    """A third in float32 is beyond a third in float64. Integers are rounded, and choices begin with any number."""
    third = np.array([1 / 3])
    boxes = Box(third, 2 * third, dtype=np.float64), Box(-3, 3, (1,), np.int8)
    precise, integers = (make_env("OtherActions", action_space=box).spec for box in boxes)
    assert (precise.low.dtype, precise.low[0, 0]) == (np.float64, 1 / 3)
    assert (integers.low.dtype, integers.low[0, 0]) == (np.float32, -3)
    for space in (Box(0, 5, (2,), np.int64), Box(0, 5, (2,), np.float16), Discrete(2, start=5)):
        env = make_env("OtherActions", action_space=space)
        env.reset(0)
        env.step(np.array([[3.25, 4.75]], np.float32))  # the environment asserts that the action is in the space
    assert env.spec.first_choice == 5
    for shape in ((), (2, 2)):
        with pytest.raises(LareError, match="one axis"):
            make_env("OtherActions", action_space=Box(-1, 1, shape, np.float32))


@pytest.mark.parametrize("environment", ["Pendulum-v1", "CartPole-v1"])
def test_episode_equals_gymnasium(environment):
    task = toy_spec(environment=environment, max_episode_steps=40)
    env, expected = GymnasiumEnv(task), gymnasium.make(environment, max_episode_steps=40)
    rng, spec = np.random.default_rng(0), env.spec
    timestep, (observation, _) = env.reset(11), expected.reset(seed=11)
    np.testing.assert_array_equal(timestep.observation, observation[None])
    assert timestep.reward.tolist() == [0]
    steps, done = 0, False
    while not done:
        number = rng.integers(2)
        action = np.eye(2, dtype=np.float32)[[number]] if spec.discrete else np.array([[number]], np.float32)
        timestep, steps = env.step(action), steps + 1
        observation, reward, terminated, truncated, _ = expected.step(number if spec.discrete else action[0])
        np.testing.assert_array_equal(timestep.observation, observation[None])
        np.testing.assert_array_equal(timestep.reward, np.array([reward], np.float32))
        assert (timestep.terminated, timestep.truncated) == (terminated, truncated)
        assert (timestep.alive.tolist(), timestep.available.tolist()) == ([True], [[True] * spec.action_size])
        assert (timestep.state.shape, timestep.measures) == ((0,), {})
        done = terminated or truncated
    env.close()
    expected.close()
    # The pole falls before the limit, the pendulum does not.
    assert (steps == 40) == (not timestep.terminated) == (environment == "Pendulum-v1")


def test_observations_are_copied():
    env = make_env("Reuses")
    timesteps = [env.reset(0), env.step(STILL), env.step(STILL)]
    first = timesteps[0].observation[0, 0]
    assert [timestep.observation.tolist() for timestep in timesteps] == [[[first + step] * 2] for step in range(3)]


def test_measures_are_those_of_the_last_step():
    env = GymnasiumEnv(toy_spec(measures=("distance",), max_episode_steps=2))
    assert env.spec.measures == ("distance",)
    first, middle, last = env.reset(0), env.step(STILL), env.step(STILL)
    assert (first.measures, middle.measures) == ({"distance": 0}, {"distance": 0})
    assert last.measures == {"distance": abs(last.observation[0, 0])}
    assert last.observation[0, 0] != 0


@pytest.mark.parametrize(
    ("kwargs", "content"),
    [
        ({"observation": np.array([0, np.nan], np.float32)}, r"observation contains nan in entry 1 \(noise\)$"),
        ({"observation": np.zeros(3)}, "observation has the shape"),
        ({"reward": 1e39}, "reward contains inf"),
        ({"info": None}, "info None, which is not a dictionary"),
        ({"terminated": np.array([True, False])}, "failed in step: The truth value"),
        ({"fail_in": "reset", "error": OSError("no asset\ntrack.bin")}, "reset: no asset track.bin$"),
        ({"fail_in": "reset", "error": OSError("x" * 1000)}, f"reset: {'x' * MAX_ERROR}...$"),
        ({"fail_in": "step", "error": ZeroDivisionError()}, "step: ZeroDivisionError$"),
        ({"fail_in": "step", "error": LareError("no battery")}, "^no battery$"),
        ({"fail_in": "render", "error": IndexError("range")}, "render: range$"),
        ({"info": {}, "terminated": True}, "'won'.*is empty"),
        ({"info": {"lost": 1, 3: 4}, "terminated": True}, "'won'.*only 3, lost"),
        ({"info": {"level": 64}}, "group 'level'.*64.*from 0 to 63"),
        ({"info": {"level": np.nan}}, "group 'level'.*nan"),
    ],
)
def test_invalid_value_or_failure(kwargs, content):
    def use(env):
        for timestep in (env.reset(0), env.step(STILL), env.step(STILL)):
            check_finite(timestep, env.spec, "the environment")
        env.render()

    measures = ("won",) if kwargs.get("terminated") is True else ()
    group = "level" if "level" in (kwargs.get("info") or {}) else None
    texts = {"observation": "0: the target\n1: noise"}
    task = toy_spec(environment="foreign/Invalid-v0", measures=measures, group=group, **texts)
    env = GymnasiumEnv(task, **kwargs)
    with pytest.raises(LareError, match=content) as error, one_line_errors("a caller"):
        use(env)
    assert "\n" not in str(error.value)
    assert kwargs.get("error") in (None, error.value, error.value.__cause__)  # `lare-rl --debug` prints the cause
    assert isinstance(error.value, EnvOutputError) == content.startswith(("observation", "reward"))


def test_group_is_needed_at_each_step_if_the_environment_pays_early():
    env, early = (
        GymnasiumEnv(toy_spec(environment="foreign/Invalid-v0", group="level", payments=payments))
        for payments in ("end", 1)
    )
    env.reset(0)
    assert env.step(STILL).measures == {"level": 0}
    early.reset(0)
    with pytest.raises(LareError, match="group 'level', but info has only distance"):
        early.step(STILL)


@pytest.mark.filterwarnings("ignore:.*render_mode")
def test_render():
    with contextlib.closing(GymnasiumEnv(toy_spec(environment="FrozenLake-v1"), render_mode="ansi")) as env:
        env.reset(0)
        assert "SFFF" in env.render().replace("\x1b[41mS\x1b[0m", "S")
    with pytest.raises(LareError, match="to be filmed"):
        make_gymnasium("foreign/Reuses-v0", render_mode="rgb_array")
