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
"""The module of StarCraft2Env, by a module to look for. PyPI's `smac`, another project, has none of the modules to look for."""
DIFFICULTY = "7"
"""The difficulty "very hard" of StarCraft II's built-in opponent, for which results are usually reported."""
MAX_CRASHES = 3
"""A run fails after this number of crashes without a complete episode between them."""
NO_OP = 0
"""SMAC's only action for dead units. Living units do not have it."""


def make(task: TaskSpec, **_: Any) -> "StarCraft":
    """Make the environment of a task with the name `smac/MAP`."""
    return StarCraft(task.name_in_family)


class StarCraft:
    """A map of SMAC as a `HostEnv`. The actions are SMAC's: no-op, stop, north, south, east, west, and one attack for each enemy."""

    def __init__(self, name: str, make_env: Callable[..., Any] | None = None):
        """Make SMAC's environment of a map. `make_env` is StarCraft2Env by default.

        Raises `LareError` if the package, StarCraft II or the map is missing.
        """
        self._name, self._make_env = name, make_env or _find_env_class()
        self._env: Any = None
        self._can_reset = False
        self._n_crashes = 0
        info = self._new_env(0).get_env_info()
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

    def _new_env(self, seed: int) -> Any:
        """Make SMAC's environment with this seed. Its first reset starts StarCraft II."""
        self.close()
        with one_line_errors(f"SMAC cannot make {self._name!r}"):
            self._env = self._make_env(map_name=self._name, difficulty=DIFFICULTY, seed=seed)
        return self._env

    def reset(self, seed: int) -> Timestep:
        """Start an episode. The seed acts only if StarCraft II starts anew: until an episode has ended, and after a crash."""
        # Before an episode has ended, SMAC's reset would start StarCraft II again, in addition to the running process.
        if not self._can_reset:
            self._new_env(seed)
        with one_line_errors(f"StarCraft II does not start {self._name!r}"):
            self._env.reset()
        self._steps = 0
        return self._make_timestep(np.zeros(self.spec.n_agents, np.float32), done=False, won=False)

    def step(self, action: Float[np.ndarray, "agents action"]) -> Timestep:
        """Make one step. If StarCraft II crashes, the episode is truncated, and the next `reset` starts it again.

        Raises `LareError` if SMAC refuses an action, or if StarCraft II has crashed too often.
        """
        with one_line_errors(f"StarCraft II failed in a step of {self._name!r}"):
            reward, done, info = self._env.step(np.argmax(action, axis=1).tolist())
        if done and not info:  # SMAC reports a crash only in this way
            return self._handle_crash()
        self._steps += 1
        if done:
            self._can_reset, self._n_crashes = True, 0
        rewards = np.where(self._timestep.alive, np.float32(reward), np.float32(0))
        return self._make_timestep(rewards, done=bool(done), won=bool(info.get("battle_won", False)))

    def _handle_crash(self) -> Timestep:
        """Return the previous timestep, truncated and with reward 0. Raises `LareError` after `MAX_CRASHES` crashes."""
        message = f"StarCraft II crashed in step {self._steps + 1} of an episode of {self._name}"
        self._can_reset, self._n_crashes = False, self._n_crashes + 1
        if self._n_crashes == MAX_CRASHES:
            raise LareError(f"{message}, {MAX_CRASHES} times in a row")
        warnings.warn(f"{message}: the episode ends there, and StarCraft II starts again", RuntimeWarning, stacklevel=3)
        return self._timestep._replace(reward=np.zeros_like(self._timestep.reward), truncated=np.array(True))

    def _make_timestep(self, reward: Float[np.ndarray, " agents"], done: bool, won: bool) -> Timestep:
        available = np.array(self._env.get_avail_actions(), bool)
        alive = ~available[:, NO_OP]
        at_limit = self._steps >= self.spec.max_steps
        self._timestep = Timestep(
            observation=np.stack(self._env.get_obs()).astype(np.float32),
            state=np.asarray(self._env.get_state(), np.float32),
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
            return self._env.render(mode="rgb_array")

    def close(self) -> None:
        if self._env is not None:
            close_env(self._env, f"StarCraft II on {self._name!r}")
            self._env = None
        self._can_reset = False


def _find_env_class() -> Callable[..., Any]:
    modules = [module for marker, module in PACKAGES.items() if _is_installed(marker)]
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
