"""SMAC (Samvelyan et al., 2019): battles in StarCraft II itself, which runs in a separate process.

The package is `smacv2` (Ellis et al., 2023) or `smac`, from their repositories: `smac` on PyPI is another project. The game and
SMAC's maps must be installed separately.
"""

import importlib
import warnings
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lare_rl.envs.env_errors import close_env, one_line_errors
from lare_rl.envs.interface import EnvSpec, Team, Timestep
from lare_rl.errors import LareError
from lare_rl.tasks.spec import TaskSpec
from lare_rl.util.variables import read_variable

__all__ = ["StarCraft", "make"]

PACKAGES = {"smacv2.env": "smacv2.env", "smac.env.starcraft2": "smac.env"}
"""The module with the game by a module that only the right package has: PyPI's `smac` has none of these."""
DIFFICULTY = "7"
"""The difficulty "very hard" of the game's built-in opponent, for which results are usually reported."""
MAX_CRASHES = 3
"""A run fails after this number of crashes without a complete episode between them."""
NO_OP = 0
"""SMAC's only action for dead units. Living units do not have it."""


def make(task: TaskSpec, **_: Any) -> "StarCraft":
    """Make the environment of a task with the name `smac/MAP`."""
    return StarCraft(task.name_in_family)


class StarCraft:
    """A map of SMAC as a `HostEnv`. The actions are SMAC's: no-op, stop, north, south, east, west, and one attack for each enemy."""

    def __init__(self, name: str, make_game: Callable[..., Any] | None = None):
        """Make the game of a map, by default with SMAC's class.

        Raises `LareError` if the package, StarCraft II or the map is missing.
        """
        self._name, self._make_game = name, make_game or _find_game()
        self._game: Any = None
        self._can_continue = False
        self._n_crashes = 0
        info = self._launch(0).get_env_info()
        self.spec = EnvSpec(
            teams=(Team("ally", 0, info["n_agents"]),),
            observation_size=info["obs_shape"],
            action_size=info["n_actions"],
            discrete=True,
            max_steps=info["episode_limit"],
            state_size=info["state_shape"],
            agents_leave=True,
            masks_actions=True,
            measures=("won",),
        )

    def _launch(self, seed: int) -> Any:
        """Make a game with this seed. StarCraft II itself starts with the first episode."""
        self.close()
        with one_line_errors(f"SMAC cannot make {self._name!r}"):
            self._game = self._make_game(map_name=self._name, difficulty=DIFFICULTY, seed=seed)
        return self._game

    def reset(self, seed: int) -> Timestep:
        """Start an episode. Only the first of a game follows its seed: SMAC takes a seed only for a new game, which starts slowly."""
        # Before an episode has ended, SMAC's reset would start another game in addition to the running one.
        if not self._can_continue:
            self._launch(seed)
        with one_line_errors(f"StarCraft II does not start {self._name!r}"):
            self._game.reset()
        self._steps = 0
        return self._make_timestep(np.zeros(self.spec.n_agents, np.float32), done=False, won=False)

    def step(self, action: Float[np.ndarray, "agents action"]) -> Timestep:
        """Make one step. If the game crashes, the episode is truncated, and the next `reset` starts a new game.

        Raises `LareError` if SMAC refuses an action, or if the game has crashed too often.
        """
        with one_line_errors(f"StarCraft II failed in a step of {self._name!r}"):
            reward, done, info = self._game.step(np.argmax(action, axis=1).tolist())
        if done and not info:  # SMAC reports a crash only in this way
            return self._handle_crash()
        self._steps += 1
        if done:
            self._can_continue, self._n_crashes = True, 0
        rewards = np.where(self._timestep.alive, np.float32(reward), np.float32(0))
        return self._make_timestep(rewards, done=bool(done), won=bool(info.get("battle_won", False)))

    def _handle_crash(self) -> Timestep:
        """Return the previous timestep, truncated and with reward 0. Raises `LareError` after `MAX_CRASHES` crashes."""
        message = f"StarCraft II crashed in step {self._steps + 1} of an episode of {self._name}"
        self._can_continue, self._n_crashes = False, self._n_crashes + 1
        if self._n_crashes == MAX_CRASHES:
            raise LareError(f"{message}, {MAX_CRASHES} times in a row")
        warnings.warn(f"{message}: the episode ends there, and the game starts again", RuntimeWarning, stacklevel=3)
        return self._timestep._replace(reward=np.zeros_like(self._timestep.reward), truncated=np.array(True))

    def _make_timestep(self, reward: Float[np.ndarray, " agents"], done: bool, won: bool) -> Timestep:
        available = np.array(self._game.get_avail_actions(), bool)
        alive = ~available[:, NO_OP]
        at_limit = self._steps >= self.spec.max_steps
        self._timestep = Timestep(
            observation=np.stack(self._game.get_obs()).astype(np.float32),
            state=np.asarray(self._game.get_state(), np.float32),
            available=available,
            alive=alive,
            reward=reward,
            # SMAC says only that the episode is done: at the limit, it has terminated if a side has won.
            terminated=np.array(done and (not at_limit or won or not alive.any())),
            truncated=np.array(at_limit),
            measures={"won": np.array(won, np.float32)},
        )
        return self._timestep

    def render(self) -> Any:
        with one_line_errors(f"StarCraft II cannot draw {self._name!r}"):
            return self._game.render(mode="rgb_array")

    def close(self) -> None:
        if self._game is not None:
            close_env(self._game, f"StarCraft II on {self._name!r}")
            self._game = None
        self._can_continue = False


def _find_game() -> Callable[..., Any]:
    modules = [game_module for marker, game_module in PACKAGES.items() if _is_installed(marker)]
    if not modules:
        raise LareError(
            "SMAC is not installed: pip install git+https://github.com/oxwhirl/smacv2.git"
            " (the package that PyPI calls smac is another project)"
        )
    folder = Path(read_variable("SC2PATH") or "~/StarCraftII").expanduser()
    if not folder.is_dir():
        raise LareError(
            f"StarCraft II is not at {folder}. Set SC2PATH to its folder, with SMAC's maps in Maps/SMAC_Maps."
        )
    with one_line_errors(f"{modules[0]} cannot be imported"):  # its old protocol buffers fail with a new protobuf
        return importlib.import_module(modules[0]).StarCraft2Env


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ImportError:  # a parent is missing
        return False
