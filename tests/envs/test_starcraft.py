import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.fake_smac import FROM_SMAC, FakeSmac
from lare_rl.envs.interface import HostEnv
from lare_rl.envs.smax.smax_env import SMAX
from lare_rl.envs.starcraft import StarCraft, find_game
from lare_rl.errors import LareError

TO_SMAC = np.array([*(FROM_SMAC.index(one) for one in range(4)), 1, *range(6, 11)])
"""SMAX's choices, as SMAC counts them."""


@pytest.fixture(autouse=True)
def nothing_was_launched():
    FakeSmac.launched = ()


def legal(seen, random) -> np.ndarray:
    """A random legal choice of each agent, as rows."""
    choice = np.argmax(seen.available * random.uniform(0.5, 1, seen.available.shape), axis=1)
    return np.eye(seen.available.shape[1], dtype=np.float32)[choice]


def test_says_what_the_game_says():
    env: HostEnv = StarCraft("2s3z", game=FakeSmac)
    spec = env.spec
    assert (spec.agents, spec.action_size, spec.max_steps) == (5, 11, 120)
    assert (spec.observation_size, spec.state_size) == (127, 120)
    assert spec.discrete
    assert spec.masks_actions
    assert spec.agents_leave
    assert spec.measures == ("won",)


def test_an_episode_is_that_of_the_battle_within():
    env, battle = StarCraft("2s3z", game=FakeSmac), SMAX("2s3z")
    key, random, step = jax.random.key(7), np.random.default_rng(0), jax.jit(battle.step)
    seen = env.reset(7)
    key, start = jax.random.split(key)
    state, expected = jax.jit(battle.reset)(start)
    steps, left = 0, 0
    while True:
        np.testing.assert_array_equal(seen.observation, expected.observation)
        np.testing.assert_array_equal(seen.state, expected.state)
        np.testing.assert_array_equal(seen.alive, expected.alive)
        np.testing.assert_array_equal(
            seen.available[:, 1:][seen.alive][:, TO_SMAC - 1], expected.available[expected.alive]
        )
        np.testing.assert_array_equal(seen.reward, expected.reward)
        assert (seen.terminated, seen.truncated) == (expected.terminated, expected.truncated)
        assert seen.measures["won"] == expected.measures["won"]
        if seen.terminated or seen.truncated:
            break
        rows = legal(seen, random)
        assert (rows[~seen.alive].argmax(1) == 0).all()
        left += (~seen.alive).sum()
        choice = [FROM_SMAC[one] if one < 6 else one - 1 for one in rows.argmax(1)]
        seen = env.step(rows)
        key, now = jax.random.split(key)
        state, expected = step(state, jax.nn.one_hot(jnp.array(choice), 10), now)
        steps += 1
    assert steps > 10
    assert left > 0


def test_time_that_runs_out_is_no_end_of_its_own():
    env = StarCraft("2s3z", game=FakeSmac)
    seen = env.reset(0)
    env.steps = 119
    env.game.state = env.game.state._replace(battle=env.game.state.battle._replace(step=jnp.array(119, jnp.int32)))
    seen = env.step(np.eye(11, dtype=np.float32)[[1] * 5])
    assert seen.truncated
    assert not seen.terminated


STOP = np.eye(11, dtype=np.float32)[[1] * 5]


def test_an_episode_in_which_the_game_crashes_is_truncated_and_the_next_one_is_whole():
    env = StarCraft("2s3z", game=partial(FakeSmac, crash_at=2))
    env.reset(0)
    before = env.step(STOP)
    said = r"^StarCraft II crashed in step 2 of an episode of 2s3z: the episode ends there, and the game starts again$"
    with pytest.warns(RuntimeWarning, match=said):
        seen = env.step(STOP)
    assert seen.truncated
    assert not seen.terminated
    assert (seen.reward == 0).all()
    np.testing.assert_array_equal(seen.state, before.state)
    seen = env.reset(1)
    assert FakeSmac.launched == (0, 0, 1)
    assert seen.alive.all()
    assert env.steps == 0


def test_a_game_that_crashes_again_and_again_ends_the_run():
    env = StarCraft("2s3z", game=partial(FakeSmac, crash_at=1))
    for seed in range(2):
        env.reset(seed)
        with pytest.warns(RuntimeWarning):
            env.step(STOP)
    env.reset(2)
    said = r"^StarCraft II crashed in step 1 of an episode of 2s3z; that makes 3 crashes in a row$"
    with pytest.raises(LareError, match=said):
        env.step(STOP)


def test_what_is_not_available_is_refused_before_the_game_does():
    env = StarCraft("2s3z", game=FakeSmac)
    env.reset(0)
    with pytest.raises(LareError, match="agent 0 of 2s3z chose action 0, which is not available to it now"):
        env.step(np.eye(11, dtype=np.float32)[[0] * 5])


def test_the_game_is_started_once_unless_every_seed_shall_count():
    env, random = StarCraft("2s3z", game=FakeSmac), np.random.default_rng(0)
    seen = env.reset(3)
    while not (seen.terminated or seen.truncated):
        seen = env.step(legal(seen, random))
    env.reset(4)
    env.reset(5)
    assert FakeSmac.launched == (0, 3)
    env = StarCraft("2s3z", relaunch=True, game=FakeSmac)
    first, other, again = env.reset(3), env.reset(4), env.reset(3)
    assert FakeSmac.launched[2:] == (0, 3, 4, 3)
    np.testing.assert_array_equal(first.state, again.state)
    assert (first.state != other.state).any()


def test_no_second_game_runs_beside_the_first_where_no_episode_has_ended():
    env = StarCraft("2s3z", game=FakeSmac)
    env.reset(3)
    first = env.game
    env.reset(4)
    assert first.closed
    assert FakeSmac.launched == (0, 3, 4)


def test_renders_and_closes():
    env = StarCraft("2s3z", game=FakeSmac)
    env.reset(0)
    game = env.game
    assert env.render().shape == (4, 4, 3)
    env.close()
    env.close()
    assert game.closed


def test_what_the_game_complains_of_is_one_line():
    def refuse(**_):
        raise KeyError("no map\n2s3y")

    with pytest.raises(LareError, match=r"SMAC cannot make '2s3y': .*no map") as error:
        StarCraft("2s3y", game=refuse)
    assert "\n" not in str(error.value)


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Puts packages on the path, which Python forgets afterwards."""
    monkeypatch.syspath_prepend(tmp_path)

    def write(path: str, text: str = "") -> None:
        file = tmp_path / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)

    yield write
    for name in [name for name in sys.modules if name.split(".")[0] in ("smac", "smacv2")]:
        del sys.modules[name]


def test_the_other_smac_is_not_taken_for_it(package):
    package("smac/__init__.py")
    with pytest.raises(LareError, match=r"SMAC is not installed: pip install git.*PyPI calls smac is another project"):
        find_game()


@pytest.mark.parametrize("files", [("smacv2/env",), ("smac/env", "smac/env/starcraft2")])
def test_without_the_game_its_folder_is_named(package, files, monkeypatch, tmp_path):
    package(f"{files[0].split('/')[0]}/__init__.py")
    for file in files:
        package(f"{file}/__init__.py", "StarCraft2Env = dict")
    monkeypatch.setenv("SC2PATH", str(tmp_path / "nowhere"))
    with pytest.raises(LareError, match=r"StarCraft II is not at .*nowhere: set SC2PATH to its folder"):
        find_game()
    monkeypatch.setenv("SC2PATH", str(tmp_path))
    assert find_game() is dict


def test_a_package_that_does_not_import_says_why(package, monkeypatch, tmp_path):
    package("smacv2/__init__.py")
    package("smacv2/env/__init__.py", "raise TypeError('Descriptors cannot\\nbe created directly')")
    monkeypatch.setenv("SC2PATH", str(tmp_path))
    with pytest.raises(LareError, match=r"smacv2.env cannot be imported: Descriptors cannot be created directly"):
        find_game()
