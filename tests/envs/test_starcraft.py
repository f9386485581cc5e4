"""SMAC through a mock of the game, whose battles are SMAX's."""

import sys
from contextlib import nullcontext
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.fake_smac import FROM_SMAC, FakeSmac, compiled_smax
from lare_rl.envs.starcraft import StarCraft
from lare_rl.errors import LareError

TO_SMAC = np.array([*(FROM_SMAC.index(action) for action in range(4)), 1, *range(6, 11)])
"""The numbers of SMAX's actions in SMAC."""


@pytest.fixture(autouse=True)
def no_launches():
    FakeSmac.launched = ()


def sample_actions(timestep, rng) -> np.ndarray:
    """Random available actions, one-hot."""
    choices = np.argmax(timestep.available * rng.uniform(0.5, 1, timestep.available.shape), axis=1)
    return np.eye(timestep.available.shape[1], dtype=np.float32)[choices]


def test_episode_equals_smax():
    env, (_, reset, step) = StarCraft("2s3z", make_env=FakeSmac), compiled_smax("2s3z")
    key, rng = jax.random.key(7), np.random.default_rng(0)
    timestep = env.reset(7)
    key, start_key = jax.random.split(key)
    state, expected = reset(start_key)
    spec = env.spec
    sizes = (spec.n_agents, spec.action_size, spec.max_steps, spec.observation_size, spec.state_size)
    assert sizes == (5, 11, 120, 127, 120)
    assert (spec.discrete, spec.masks_actions, spec.agents_leave, spec.measures) == (True, True, True, ("won",))
    steps, n_dead = 0, 0
    while True:
        available = timestep.available[timestep.alive][:, TO_SMAC]
        np.testing.assert_array_equal(available, expected.available[expected.alive])
        for values, smax_values in zip(timestep._replace(available=()), expected._replace(available=()), strict=True):
            jax.tree.map(np.testing.assert_array_equal, values, smax_values)
        if timestep.terminated or timestep.truncated:
            break
        action = sample_actions(timestep, rng)
        assert (action[~timestep.alive].argmax(1) == 0).all()
        n_dead += (~timestep.alive).sum()
        choices = [FROM_SMAC[choice] if choice < 6 else choice - 1 for choice in action.argmax(1)]
        timestep = env.step(action)
        key, step_key = jax.random.split(key)
        state, expected = step(state, jax.nn.one_hot(jnp.array(choices), 10), step_key)
        steps += 1
    assert steps > 10
    assert n_dead > 0


STOP = np.eye(11, dtype=np.float32)[[1] * 5]


@pytest.mark.parametrize("won", [False, True])
def test_time_limit(won):
    """A battle that is won in the last step has terminated too."""

    class Ending(FakeSmac):
        def step(self, actions):
            super().step(actions)
            return 1.0, True, {"battle_won": won}

    env = StarCraft("2s3z", make_env=Ending)
    env.reset(0)
    env.spec = replace(env.spec, max_steps=1)
    timestep = env.step(STOP)
    assert (bool(timestep.truncated), bool(timestep.terminated)) == (True, won)


def test_crash_truncates_the_episode():
    env = StarCraft("2s3z", make_env=partial(FakeSmac, crash_at=2))
    env.reset(0)
    previous = env.step(STOP)
    with pytest.warns(RuntimeWarning, match="crashed in step 2"):
        timestep = env.step(STOP)
    assert (bool(timestep.truncated), bool(timestep.terminated)) == (True, False)
    assert not timestep.reward.any()
    np.testing.assert_array_equal(timestep.state, previous.state)
    assert env.reset(1).alive.all()
    assert FakeSmac.launched == (0, 0, 1)


def test_repeated_crashes_end_the_run():
    """A complete episode between crashes starts a new count."""
    infos = iter([{}, {}, {"battle_won": False}, {}, {}, {}])  # at the end of each episode; a crash has none

    class Ending(FakeSmac):
        def step(self, actions):
            super().step(actions)
            self.ended = True
            return 0.0, True, next(infos)

    env = StarCraft("2s3z", make_env=Ending)
    for seed in range(5):
        env.reset(seed)
        with nullcontext() if seed == 2 else pytest.warns(RuntimeWarning):
            env.step(STOP)
    env.reset(5)
    with pytest.raises(LareError, match=r"crashed .* 3 times in a row"):
        env.step(STOP)


def test_launches():
    """A new game is made only for the first episode, and again if that was incomplete."""
    env, rng = StarCraft("2s3z", make_env=FakeSmac), np.random.default_rng(0)
    timestep = env.reset(3)
    while not (timestep.terminated or timestep.truncated):
        timestep = env.step(sample_actions(timestep, rng))
    env.reset(4)
    assert FakeSmac.launched == (0, 3)
    env = StarCraft("2s3z", make_env=FakeSmac)
    env.reset(3)
    env.reset(4)
    assert FakeSmac.launched[2:] == (0, 3, 4)
    assert env.render().shape == (4, 4, 3)
    env.close()
    env.close()


def test_errors(write_package, monkeypatch, tmp_path):
    env = StarCraft("2s3z", make_env=FakeSmac)
    env.reset(0)
    with pytest.raises(LareError, match=r"in a step of '2s3z': .*not available"):
        env.step(np.eye(11, dtype=np.float32)[[0] * 5])
    monkeypatch.setattr(FakeSmac, "render", lambda self, mode: 1 / 0)
    with pytest.raises(LareError, match="cannot draw '2s3z': division"):
        env.render()

    def fail(**_):
        raise KeyError("no map\n2s3y")

    with pytest.raises(LareError, match=r"cannot make '2s3y': .*no map") as error:
        StarCraft("2s3y", make_env=fail)
    assert "\n" not in str(error.value)
    write_package("smacv2")
    write_package("smacv2/env", "raise TypeError('Descriptors cannot\\nbe created directly')")
    monkeypatch.setenv("SC2PATH", str(tmp_path))
    with pytest.raises(LareError, match="cannot be imported: Descriptors cannot"):
        StarCraft("2s3z")


@pytest.fixture
def write_package(tmp_path, monkeypatch):
    """Writes packages on the path, which Python forgets afterwards."""
    monkeypatch.syspath_prepend(tmp_path)

    def write(path: str, text: str = "") -> None:
        file = tmp_path / path / "__init__.py"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)

    yield write
    for name in [name for name in sys.modules if name.split(".")[0] in ("smac", "smacv2")]:
        del sys.modules[name]


@pytest.mark.parametrize("packages", [("smacv2", "smacv2/env"), ("smac", "smac/env", "smac/env/starcraft2")])
def test_installed_game(write_package, packages, monkeypatch, tmp_path):
    write_package("smac")  # another project on PyPI
    with pytest.raises(LareError, match=r"not installed.* another project"):
        StarCraft("2s3z")
    for package in packages:
        write_package(package, "from helpers.fake_smac import FakeSmac as StarCraft2Env")
    monkeypatch.setenv("SC2PATH", str(tmp_path / "nowhere"))
    with pytest.raises(LareError, match=r"nowhere.*SC2PATH"):
        StarCraft("2s3z")
    monkeypatch.setenv("SC2PATH", str(tmp_path))
    assert StarCraft("2s3z").spec.n_agents == 5
