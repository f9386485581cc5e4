"""SMAC through a stub of the game."""

import sys
from contextlib import nullcontext
from functools import partial

import numpy as np
import pytest

from helpers.fake_smac import FakeSmac
from lare_rl.envs.starcraft import StarCraft
from lare_rl.errors import LareError


@pytest.fixture(autouse=True)
def no_launches():
    FakeSmac.launched = ()


def make_game(*results) -> StarCraft:
    return StarCraft("2s3z", make_env=partial(FakeSmac, results=iter(results)))


GOES_ON, LOST, WON = (
    (1.0, False, {"battle_won": False}),
    (1.0, True, {"battle_won": False}),
    (1.0, True, {"battle_won": True}),
)
CRASH = (0.0, True, {})


def play(env: StarCraft, seed: int, n_steps: int):
    """Play the first available actions. Return all timesteps."""
    timesteps = [env.reset(seed)]
    for _ in range(n_steps):
        timesteps.append(env.step(np.eye(3, dtype=np.float32)[timesteps[-1].available.argmax(axis=1)]))
    return timesteps


def test_episode():
    """Arrays pass through. A dead unit is one that has only no-op, and earns nothing after the step in which it dies."""
    env = make_game(GOES_ON, WON)
    spec = env.spec
    sizes = (spec.n_agents, spec.action_size, spec.max_steps, spec.observation_size, spec.state_size)
    assert sizes == (2, 3, 3, 4, 5)
    assert (spec.discrete, spec.masks_actions, spec.agents_leave, spec.measures) == (True, True, True, ("won",))
    timesteps = play(env, 7, 2)
    for step, timestep in enumerate(timesteps):
        np.testing.assert_array_equal(timestep.observation, np.float32([[10 + step] * 4, [20 + step] * 4]), strict=True)
        np.testing.assert_array_equal(timestep.state, np.float32([step] * 5), strict=True)
        assert timestep.available.tolist() == [
            [False, True, True],
            [True, False, False] if step else [False, True, False],
        ]
        assert timestep.alive.tolist() == [True, step == 0]
        assert timestep.measures == {"won": step == 2}
        assert (bool(timestep.terminated), bool(timestep.truncated)) == (step == 2, False)
    assert [timestep.reward.tolist() for timestep in timesteps] == [[0, 0], [1, 1], [1, 0]]


@pytest.mark.parametrize("end", [LOST, WON])
def test_time_limit(end):
    """A battle that is won in the last step has terminated too."""
    *_, last = play(make_game(GOES_ON, GOES_ON, end), 0, 3)
    assert (bool(last.truncated), bool(last.terminated)) == (True, end == WON)


def test_crash_truncates_the_episode():
    env = make_game(GOES_ON, CRASH)
    with pytest.warns(RuntimeWarning, match="crashed in step 2"):
        _, previous, last = play(env, 0, 2)
    assert (bool(last.truncated), bool(last.terminated)) == (True, False)
    assert not last.reward.any()
    np.testing.assert_array_equal(last.state, previous.state)
    assert env.reset(1).alive.all()
    assert FakeSmac.launched == (0, 0, 1)


def test_repeated_crashes_end_the_run():
    """A complete episode between crashes starts a new count."""
    env = make_game(CRASH, CRASH, LOST, CRASH, CRASH, CRASH)
    for seed in range(5):
        with nullcontext() if seed == 2 else pytest.warns(RuntimeWarning):
            play(env, seed, 1)
    with pytest.raises(LareError, match=r"crashed .* 3 times in a row"):
        play(env, 5, 1)


def test_launches():
    """A new game is made only for the first episode, and again if that was incomplete."""
    env = make_game(LOST)
    play(env, 3, 1)
    env.reset(4)
    env.reset(5)
    assert FakeSmac.launched == (0, 3)
    env = make_game()
    env.reset(3)
    env.reset(4)
    assert FakeSmac.launched[2:] == (0, 3, 4)
    assert env.render().shape == (4, 4, 3)
    env.close()
    env.close()


def test_errors(monkeypatch):
    env = make_game()
    env.reset(0)
    with pytest.raises(LareError, match=r"in a step of '2s3z': .*not available"):
        env.step(np.eye(3, dtype=np.float32)[[0, 0]])
    monkeypatch.setattr(FakeSmac, "render", lambda self, mode: 1 / 0)
    with pytest.raises(LareError, match="cannot draw '2s3z': division"):
        env.render()

    def fail(**_):
        raise KeyError("no map\n2s3y")

    with pytest.raises(LareError, match=r"cannot make '2s3y': .*no map") as error:
        StarCraft("2s3y", make_env=fail)
    assert "\n" not in str(error.value)


IMPORT = "from helpers.fake_smac import FakeSmac as StarCraft2Env"


@pytest.mark.parametrize(
    ("packages", "folder", "message"),
    [
        ({"smac": ""}, "", "not installed.* another project"),  # the one on PyPI
        ({"smac": "", "smacv2": "", "smacv2/env": IMPORT}, "", None),
        ({"smac": "", "smac/env": IMPORT, "smac/env/starcraft2": ""}, "", None),
        ({"smacv2": "", "smacv2/env": IMPORT}, "nowhere", "nowhere.*SC2PATH"),
        ({"smacv2": "", "smacv2/env": "raise TypeError('Descriptors\\ncannot')"}, "", "imported: Descriptors cannot"),
    ],
)
def test_installed_game(packages, folder, message, monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("SC2PATH", str(tmp_path / folder))
    for path, text in packages.items():
        (tmp_path / path).mkdir(exist_ok=True)
        (tmp_path / path / "__init__.py").write_text(text)
    try:
        with pytest.raises(LareError, match=message) if message else nullcontext():
            assert StarCraft("2s3z").spec.n_agents == 2
    finally:
        for name in [name for name in sys.modules if name.split(".")[0] in ("smac", "smacv2")]:
            del sys.modules[name]
