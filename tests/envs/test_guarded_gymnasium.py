"""Environments that fail, in one line."""

import gymnasium
import numpy as np
import pytest

from helpers.toys import Chase, toy_spec
from lare_rl.envs.guarded_gymnasium import make, number
from lare_rl.errors import LareError
from lare_rl.latent.verify import random_steps


class Falters(Chase):
    """Fails where it is told to."""

    def __init__(self, where):
        super().__init__()
        self.where = where

    def reset(self, *, seed=None, options=None):
        if self.where == "reset":
            raise OSError("no asset\ntrack.bin")
        return super().reset(seed=seed, options=options)

    def step(self, action):
        if self.where == "step":
            raise ZeroDivisionError
        if self.where == "window":
            raise SystemExit(0)
        if self.where == "reward":
            return (*super().step(action)[:1], None, False, False, {})
        if self.where == "itself":
            raise LareError("the battery is empty")
        return super().step(action)

    def render(self):
        return [][0] if self.where == "render" else np.zeros((2, 2, 3), np.uint8)

    def close(self):
        if self.where == "close":
            raise TypeError("'float' object is not callable")


for where in ("reset", "step", "itself", "window", "reward", "close", "render"):
    gymnasium.register(f"misfits/{where}-v0", entry_point=Falters, kwargs={"where": where}, max_episode_steps=20)


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ("reset", "environment 'misfits/reset-v0' failed in reset: no asset"),
        ("step", "environment 'misfits/step-v0' failed in step: ZeroDivisionError"),
        ("close", "environment 'misfits/close-v0' failed in close: 'float' object is not callable"),
        ("itself", "the battery is empty"),
        ("window", "environment 'misfits/window-v0' failed in step: 0"),
        ("reward", "environment 'misfits/reward-v0' gave the reward None, which is no number"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*The reward returned by")  # Gymnasium has seen it too
def test_a_failure_is_one_line(where, message):
    with pytest.raises(LareError) as error:
        random_steps(toy_spec(environment=f"misfits/{where}-v0"), 1)
    assert str(error.value) == message


def test_a_failing_film_is_one_line():
    environment = make("misfits/render-v0")
    environment.reset(seed=0)
    with pytest.raises(LareError, match=r"^environment 'misfits/render-v0' failed in render: list index out of range$"):
        environment.render()


def test_gymnasium_can_make_it_again():
    environment = make("toys/Chase-v0")
    assert environment.spec is not None
    assert gymnasium.make(environment.spec).reset(seed=0)[0] == pytest.approx(environment.reset(seed=0)[0])


def test_many_numbers_for_one_are_a_line_too():
    with pytest.raises(LareError) as error:
        number(np.zeros(40), "the reward")
    assert "\n" not in str(error.value)
    assert str(error.value).endswith("..., which is no number")


@pytest.mark.filterwarnings("ignore:.*render_mode")  # Gymnasium warns first
def test_an_environment_that_cannot_be_filmed_is_one_line():
    with pytest.raises(LareError) as error:
        make("misfits/step-v0", render_mode="rgb_array")
    assert str(error.value).startswith("environment 'misfits/step-v0' cannot be made: ")
    assert str(error.value).endswith(' (to be filmed, it must accept render_mode="rgb_array")')
