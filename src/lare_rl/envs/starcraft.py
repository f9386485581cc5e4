"""SMAC (Samvelyan et al., 2019): battles in StarCraft II itself, which runs in a separate process.

The package is `smacv2` (Ellis et al., 2023) or `smac`, from their repositories: `smac` on PyPI is another project. The game and
SMAC's maps must be installed separately.
"""

import importlib
import os
import warnings
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from lare_rl.envs.interface import EnvSpec, Team, Timestep
from lare_rl.errors import LareError

NAMESPACE = "smac/"
"""The prefix of such environments in a spec. The rest is the map's name."""
PACKAGES = {"smacv2.env": "smacv2.env", "smac.env.starcraft2": "smac.env"}
"""For each package, a module that no other package has, and the module that contains the game."""
DIFFICULTY = "7"
"""The difficulty of the game's built-in opponent: "very hard", for which results are usually reported."""
CRASHES = 3
"""After this many crashes in a row, without a complete episode between them, the run fails."""
NOTHING = 0
"""The only choice of dead units. Living units do not have it."""


class StarCraft:
    """A map of SMAC as a `HostEnv`. Its choices are SMAC's: nothing, stop, north, south, east, west, and to attack each enemy.

    Args:
        name: the name of the map.
        relaunch: start the game again at each `reset`, with the given seed. SMAC accepts a seed only at the start of a game, and
            a start takes many seconds. Without it, only the first episode follows its seed, and later ones continue from there.
        game: a function that makes the game, in place of the installed package.
    """

    spec: EnvSpec

    def __init__(self, name: str, relaunch: bool = False, game: Callable[..., Any] | None = None):
        self.name, self.relaunch = name, relaunch
        self.make = game or find_game()
        self.game: Any = None
        self.steps = 0
        self.alive = np.zeros(0, bool)
        self.goes_on = False
        self.crashes = 0
        info = self.launch(0).get_env_info()
        agents, choices = info["n_agents"], info["n_actions"]
        self.available = np.zeros((agents, choices), bool)
        self.spec = EnvSpec(
            teams=(Team("ally", 0, agents),),
            observation_size=info["obs_shape"],
            action_size=choices,
            discrete=True,
            max_steps=info["episode_limit"],
            state_size=info["state_shape"],
            agents_leave=True,
            masks_actions=True,
            measures=("won",),
        )

    def launch(self, seed: int) -> Any:
        """Make a game with this seed. StarCraft II itself only starts with the first episode."""
        self.close()
        try:
            self.game = self.make(map_name=self.name, difficulty=DIFFICULTY, seed=seed)
        except Exception as error:  # the package may raise anything about a map or the game
            raise LareError(f"SMAC cannot make {self.name!r}: {one_line(error)}") from error
        return self.game

    def reset(self, seed: int) -> Timestep:
        """The first step of an episode."""
        # Before an episode has ended, SMAC's reset would start another game in addition to the running one.
        if self.relaunch or not self.goes_on:
            self.launch(seed)
        try:
            self.game.reset()
        except Exception as error:
            raise LareError(f"StarCraft II does not start {self.name!r}: {one_line(error)}") from error
        self.steps = 0
        return self.show(np.zeros(self.spec.agents, np.float32), over=False, won=False)

    def step(self, action: Float[np.ndarray, "agents action"]) -> Timestep:
        """One step. If the game crashes, the episode is truncated, and the next `reset` starts the game again.

        Raises:
            LareError: an agent chose an action that is not available, or the game has crashed too often.
        """
        choice = np.argmax(action, axis=1)
        for agent, one in enumerate(choice):
            if not self.available[agent, one]:
                raise LareError(f"agent {agent} of {self.name} chose action {one}, which is not available to it now")
        lived = self.alive
        reward, over, info = self.game.step([int(one) for one in choice])
        if over and not info:  # SMAC reports a crash only in this way
            return self.crashed()
        self.steps += 1
        if over:
            self.goes_on, self.crashes = True, 0
        paid = np.where(lived, np.float32(reward), np.float32(0))
        return self.show(paid, over=bool(over), won=bool(info.get("battle_won", False)))

    def crashed(self) -> Timestep:
        """The step in which the game crashed: its reward is 0, and it repeats the previous observations and ends the episode."""
        said = f"StarCraft II crashed in step {self.steps + 1} of an episode of {self.name}"
        self.goes_on, self.crashes = False, self.crashes + 1
        if self.crashes == CRASHES:
            raise LareError(f"{said}; that makes {CRASHES} crashes in a row")
        warnings.warn(f"{said}: the episode ends there, and the game starts again", RuntimeWarning, stacklevel=3)
        return self.shown._replace(reward=np.zeros_like(self.shown.reward), truncated=np.array(True))

    def show(self, paid: Float[np.ndarray, " agents"], over: bool, won: bool) -> Timestep:
        """The timestep after a step with this reward. SMAC itself does not distinguish truncation from termination."""
        self.available = np.array(self.game.get_avail_actions(), bool)
        self.alive = living(self.available)
        late = self.steps >= self.spec.max_steps
        self.shown = Timestep(
            observation=np.stack([np.asarray(one, np.float32) for one in self.game.get_obs()]),
            state=np.asarray(self.game.get_state(), np.float32),
            available=self.available,
            alive=self.alive,
            reward=paid,
            terminated=np.array(over and (not late or won or not self.alive.any())),
            truncated=np.array(late),
            measures={"won": np.array(won, np.float32)},
        )
        return self.shown

    def render(self) -> Any:
        """The battle as pixels (height, width, 3)."""
        return self.game.render(mode="rgb_array")

    def close(self) -> None:
        """End the game."""
        if self.game is not None:
            self.game.close()
            self.game = None
        self.goes_on = False


def living(available: Bool[np.ndarray, "agents choices"]) -> Bool[np.ndarray, " agents"]:
    """Which units are alive: only dead units have the choice `NOTHING`."""
    return ~available[:, NOTHING]


def find_game() -> Callable[..., Any]:
    """The function that makes a game.

    Raises:
        LareError: the package or StarCraft II is missing.
    """
    found = [home for module, home in PACKAGES.items() if is_there(module)]
    if not found:
        raise LareError(
            "SMAC is not installed: pip install git+https://github.com/oxwhirl/smacv2.git"
            " (the package that PyPI calls smac is another project)"
        )
    folder = Path(os.environ.get("SC2PATH", "~/StarCraftII")).expanduser()
    if not folder.is_dir():
        raise LareError(
            f"StarCraft II is not at {folder}: set SC2PATH to its folder, with SMAC's maps in Maps/SMAC_Maps"
        )
    try:
        return importlib.import_module(found[0]).StarCraft2Env
    except (ImportError, AttributeError, TypeError) as error:  # TypeError: old protocol buffers with a new protobuf
        raise LareError(f"{found[0]} cannot be imported: {one_line(error)}") from error


def is_there(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ImportError:  # a parent is missing
        return False


def one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
