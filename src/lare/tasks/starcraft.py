"""SMAC (Samvelyan et al., 2019): battles of StarCraft II itself, one game in a process beside this one.

The package is `smacv2` (Ellis et al., 2023) or `smac`, from their repositories: what PyPI calls `smac` is something else. The
game and SMAC's maps come on their own.
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

from lare.errors import LareError
from lare.tasks.env import EnvSpec, Team, Timestep

NAMESPACE = "smac/"
"""What the environment of such a task's spec begins with; the rest is the map's name."""
PACKAGES = {"smacv2.env": "smacv2.env", "smac.env.starcraft2": "smac.env"}
"""Modules that only these packages have, and where each has its game."""
DIFFICULTY = "7"
"""Of the game's own player: "very hard", on which results are reported."""
CRASHES = 3
"""In a row, without an episode between them that came to its end: then it is not chance."""
NOTHING = 0
"""The choice of the dead, and of nobody else."""


class StarCraft:
    """A map of SMAC as a `HostEnv`. Its choices are SMAC's: nothing, stop, north, south, east, west, and to attack each enemy.

    Args:
        name: the map's.
        relaunch: start the game anew at each `reset`, with its seed. SMAC takes a seed only there, and a start takes many
            seconds; otherwise only the first episode is that of its seed, and the later ones continue its chance.
        game: makes the game, if it is not the installed package's.
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
        """A game with this seed; StarCraft II itself starts with the first episode."""
        self.close()
        try:
            self.game = self.make(map_name=self.name, difficulty=DIFFICULTY, seed=seed)
        except Exception as error:  # whatever the package raises about a map or the game
            raise LareError(f"SMAC cannot make {self.name!r}: {one_line(error)}") from error
        return self.game

    def reset(self, seed: int) -> Timestep:
        """The first step of an episode."""
        # Until an episode has ended, SMAC's reset would start another game beside the one that runs.
        if self.relaunch or not self.goes_on:
            self.launch(seed)
        try:
            self.game.reset()
        except Exception as error:
            raise LareError(f"StarCraft II does not start {self.name!r}: {one_line(error)}") from error
        self.steps = 0
        return self.show(np.zeros(self.spec.agents, np.float32), over=False, won=False)

    def step(self, action: Float[np.ndarray, "agents action"]) -> Timestep:
        """One step. An episode in which the game crashes is truncated there, and the next `reset` starts the game again.

        Raises:
            LareError: an agent chose an action that is not available, or the game crashes again and again.
        """
        choice = np.argmax(action, axis=1)
        for agent, one in enumerate(choice):
            if not self.available[agent, one]:
                raise LareError(f"agent {agent} of {self.name} chose action {one}, which is not available to it now")
        lived = self.alive
        reward, over, info = self.game.step([int(one) for one in choice])
        if over and not info:  # all that SMAC says of a crash
            return self.crashed()
        self.steps += 1
        if over:
            self.goes_on, self.crashes = True, 0
        paid = np.where(lived, np.float32(reward), np.float32(0))
        return self.show(paid, over=bool(over), won=bool(info.get("battle_won", False)))

    def crashed(self) -> Timestep:
        """The step in which the game crashed: it paid nothing, and the episode ends with what was shown before it."""
        said = f"StarCraft II crashed in step {self.steps + 1} of an episode of {self.name}"
        self.goes_on, self.crashes = False, self.crashes + 1
        if self.crashes == CRASHES:
            raise LareError(f"{said}; that makes {CRASHES} crashes in a row")
        warnings.warn(f"{said}: the episode ends there, and the game starts again", RuntimeWarning, stacklevel=3)
        return self.shown._replace(reward=np.zeros_like(self.shown.reward), truncated=np.array(True))

    def show(self, paid: Float[np.ndarray, " agents"], over: bool, won: bool) -> Timestep:
        """What is seen after a step that paid so much. To SMAC the end of the time is an end like the others."""
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
    """Who acts now: only the dead may do nothing."""
    return ~available[:, NOTHING]


def find_game() -> Callable[..., Any]:
    """What makes a game.

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
    except (ImportError, AttributeError, TypeError) as error:  # TypeError: an old protocol buffer beside a new protobuf
        raise LareError(f"{found[0]} cannot be imported: {one_line(error)}") from error


def is_there(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ImportError:  # a parent is missing
        return False


def one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
