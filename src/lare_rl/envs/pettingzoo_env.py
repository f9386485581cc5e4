"""A PettingZoo environment as a `HostEnv`: `pettingzoo/MODULE:NAME`, where NAME makes a ParallelEnv.

All its output comes from foreign code, and is checked. A run must not learn from invalid values or wait for agents that have left.
"""

import contextlib
import logging
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from lare_rl.envs import agent_arrays as rows_of
from lare_rl.envs.agent_arrays import MASK, Agent
from lare_rl.envs.guarded_gymnasium import fault, number
from lare_rl.envs.interface import EnvSpec, Numbers, Timestep
from lare_rl.envs.pettingzoo_construct import construct, limit_of
from lare_rl.errors import LareError, shortened
from lare_rl.tasks.spec import TaskSpec


def make(task: TaskSpec, render_mode: str | None = None) -> "ParallelHost":
    """The task's environment. Raises `LareError` if it cannot be made, or does not match the task."""
    shown = {} if render_mode is None else {"render_mode": render_mode}
    environment = construct(task.environment, task.arguments | shown)
    try:
        return ParallelHost(environment, task)
    except BaseException:
        with contextlib.suppress(Exception):
            environment.close()
        raise


class StateFault(LareError):
    """An environment cannot return its state now."""


class ParallelHost:
    """A ParallelEnv whose agents have fixed places, no matter which of them act.

    If an agent leaves while others stay, it observes zeros from then on. At an episode's last step no agent leaves: those that
    acted still observe the result, because `phi` may judge the step by it.
    """

    spec: EnvSpec

    def __init__(self, environment: Any, task: TaskSpec):
        self.environment, self.task, self.name = environment, task, task.environment
        names = self.names()
        spaces = {name: self.spaces(name) for name in names}
        ordered, teams = rows_of.by_team(names, task)
        try:
            self.agents = [rows_of.agent(name, *spaces[name]) for name in ordered]
            rows_of.check_alike(self.agents)
        except LareError as error:
            raise LareError(f"environment {self.name!r}: {error}") from None
        self.declared = spaces
        self.max_steps = task.max_episode_steps or limit_of(environment, task.arguments)
        if self.max_steps is None:
            raise LareError(
                f"task {task.name!r}: {self.name} has no time limit, so an episode may never pay; "
                "set max_episode_steps in the task file, to the length of its longest episode or more"
            )
        self.places = {one.name: place for place, one in enumerate(self.agents)}
        self.width, self.numbered = rows_of.width(self.agents), rows_of.unlike(self.agents)
        self.full = rows_of.choices(self.agents)
        self.masks = any(one.masked for one in self.agents) or not self.full.all()
        self.judged_from_state = any(role.judged_from == "state" for role in (task, *task.teams))
        self.last_state: np.ndarray | None = None
        self.told = False
        self.looking, self.seed, self.steps = True, 0, 0
        self.clear()
        first = self.reset(0)  # needed to find out whether there is a state, and whether `info` has masks
        self.looking = False
        low, high = rows_of.bounds(self.agents)
        self.spec = EnvSpec(
            teams=teams,
            observation_size=self.width,
            action_size=self.full.shape[1],
            discrete=self.agents[0].discrete,
            max_steps=self.max_steps,
            state_size=first.state.shape[-1],
            low=low,
            high=high,
            agents_leave=True,  # no environment states that they do not
            masks_actions=self.masks,
            measures=task.measures,
        )

    def clear(self) -> None:
        self.alive = np.zeros(len(self.agents), bool)
        self.present: set[Any] = set()
        self.gone: set[Any] = set()
        """The agents that have left. They must not come back."""

    def reset(self, seed: int) -> Timestep:
        """The first step of an episode: the same for the same seed."""
        self.seed, self.steps = int(seed), 0
        self.clear()
        if not self.looking:
            self.check_unchanged()
        observations, infos = self.parts(self.call("reset", seed=self.seed), ("observations", "infos"))
        self.present = self.present_now()
        if not self.present:
            raise LareError(f"environment {self.name!r} has no agents {self.where}")
        self.alive = np.array([one.name in self.present for one in self.agents])
        return self.shown(observations, infos, self.alive, self.alive, np.zeros(len(self.agents), np.float32))

    def step(self, action: Float[np.ndarray, "agents action"]) -> Timestep:
        """One step. Continuous actions are in the environment's units; choices are rows with a single 1."""
        if not self.alive.any():
            raise LareError(f"environment {self.name!r} has no episode under way: reset it before step")
        acted = [one for one, lives in zip(self.agents, self.alive, strict=True) if lives]
        actions = {one.name: one.taken(action[self.places[one.name]]) for one in acted}
        self.steps += 1
        observations, rewards, terminations, truncations, infos = self.parts(
            self.call("step", actions), ("observations", "rewards", "terminations", "truncations", "infos")
        )
        before, self.present = self.present, self.present_now()
        self.gone |= before - self.present
        for name in (self.present - before) & self.gone:
            raise LareError(f"environment {self.name!r} brought back {name}, which had left, {self.where}")
        reward = np.zeros(len(self.agents), np.float32)
        for one in acted:
            if one.name in self.present:  # an agent that has left may be missing everywhere
                for what, values in (
                    ("rewards", rewards),
                    ("terminations", terminations),
                    ("truncations", truncations),
                ):
                    self.need(one.name, what, values)
            reward[self.places[one.name]] = self.paid(one.name, rewards.get(one.name, 0))
        over = {name: self.flag(value, "termination", name) for name, value in terminations.items()}
        cut = {name: self.flag(value, "truncation", name) for name, value in truncations.items()}
        self.gone |= {name for name in self.present if over.get(name) or cut.get(name)}
        stay = np.array([one.name in self.present and one.name not in self.gone for one in self.agents])
        ended = not stay.any()
        was_cut = ended and any(cut.get(one.name) and not over.get(one.name) for one in acted)
        truncated = was_cut or (not ended and self.steps >= self.spec.max_steps)
        shown = stay
        if ended:
            names = [one.name for one in acted if one.name in observations and not (was_cut and over.get(one.name))]
            shown = np.array([one.name in names for one in self.agents])
        terminated = ended and not was_cut
        self.alive = stay & (not truncated)
        return self.shown(observations, infos, shown, stay, reward, terminated, truncated)

    def render(self) -> Float[np.ndarray, "height width 3"] | Any:
        """The environment as pixels (height, width, 3)."""
        pixels = self.call("render")
        if not isinstance(pixels, np.ndarray) or pixels.ndim != 3 or pixels.shape[2] != 3:
            raise LareError(
                f"environment {self.name!r} renders {shortened(pixels)}, not pixels (height, width, 3): "
                "does it support the render mode 'rgb_array'?"
            )
        return pixels

    def close(self) -> None:
        """Release the resources of the environment."""
        self.call("close")

    @property
    def where(self) -> str:
        return f"{f'at step {self.steps}' if self.steps else 'at the start'} of the episode of seed {self.seed}"

    def call(self, what: str, *arguments: Any, **options: Any) -> Any:
        """Call a method of the environment. Whatever it raises becomes a `LareError` of one line."""
        try:
            return getattr(self.environment, what)(*arguments, **options)
        except (Exception, SystemExit) as error:
            raise fault(f"environment {self.name!r} failed in {what}", error) from error

    def names(self) -> list[Any]:
        names = list(getattr(self.environment, "possible_agents", None) or ())
        if not names or len(set(names)) != len(names):
            raise LareError(f"environment {self.name!r} has the possible agents {shortened(names)}: each needs a name")
        return names

    def spaces(self, name: Any) -> tuple[Any, Any]:
        return self.call("observation_space", name), self.call("action_space", name)

    def check_unchanged(self) -> None:
        """Raise `LareError` if agents or spaces differ from those that training was set up for."""
        if set(names := self.names()) != set(self.declared):
            raise LareError(
                f"environment {self.name!r} has changed its possible agents from "
                f"{shortened(list(self.declared))} to {shortened(names)}"
            )
        for name, declared in self.declared.items():
            for key, was, now in zip(("observation", "action"), declared, self.spaces(name), strict=True):
                if was is not now and was != now:
                    raise LareError(
                        f"environment {self.name!r} has changed the {key} space of {name} "
                        f"from {shortened(was)} to {shortened(now)}"
                    )

    def parts(self, answer: Any, wanted: tuple[str, ...]) -> list[Mapping[Any, Any]]:
        """Check what `reset` or `step` returned: one dictionary, by the agents' names, for each of `wanted`."""
        if not isinstance(answer, tuple) or len(answer) != len(wanted):
            raise LareError(
                f"environment {self.name!r} returned {shortened(answer)} {self.where}, not {', '.join(wanted)}"
            )
        for what, values in zip(wanted, answer, strict=True):
            if not isinstance(values, Mapping):
                raise LareError(
                    f"environment {self.name!r} returned {shortened(values)} for its {what} {self.where}, "
                    "not a dictionary by agent"
                )
            self.known(values, f"its {what}")
        return list(answer)

    def present_now(self) -> set[Any]:
        return set(self.known(getattr(self.environment, "agents", ()), "its agents"))

    def known(self, names: Collection[Any], what: str) -> Collection[Any]:
        for name in names:
            if name not in self.places and not (what == "its infos" and name == "__common__"):
                raise LareError(
                    f"environment {self.name!r} has {name!r} among {what} {self.where}, "
                    f"but its possible agents are {', '.join(map(str, self.places))}"
                )
        return names

    def need(self, name: Any, what: str, values: Mapping[Any, Any]) -> Any:
        # Not `name in values`: PettingZoo's own wrapper gives rewards as a defaultdict.
        try:
            return values[name]
        except KeyError:
            raise LareError(
                f"environment {self.name!r} gave no {what} for {name} {self.where}, although it is among its agents"
            ) from None

    def paid(self, name: Any, value: Any) -> float:
        reward = number(value, f"environment {self.name!r} gave {name} the reward")
        if not np.isfinite(reward):
            raise LareError(f"environment {self.name!r} gave {name} the reward {reward} {self.where}")
        return reward

    def flag(self, value: Any, what: str, name: Any) -> bool:
        try:
            return bool(value)
        except (TypeError, ValueError):
            raise LareError(
                f"environment {self.name!r} gave {shortened(value)} for the {what} of {name} {self.where}, which is not a truth "
                "value"
            ) from None

    def shown(
        self,
        observations: Mapping[Any, Any],
        infos: Mapping[Any, Any],
        alive: Bool[np.ndarray, " agents"],
        acting: Bool[np.ndarray, " agents"],
        reward: Float[np.ndarray, " agents"],
        terminated: bool = False,
        truncated: bool = False,
    ) -> Timestep:
        """A step. `acting` are the agents that can continue: at an episode's end, masks are ignored."""
        seen: dict[int, np.ndarray] = {}
        available = self.full.copy()
        for place, one in enumerate(self.agents):
            if alive[place]:
                given = self.need(one.name, "observations", observations)
                seen[place] = self.row(one, given)
                if acting[place]:
                    self.restrict(available[place], one, given, infos.get(one.name))
            elif one.discrete:
                available[place] = np.arange(len(available[place])) == 0
        observation = rows_of.rows(self.agents, self.width, self.numbered, seen)
        return Timestep(
            observation=observation,
            state=self.state(observation),
            available=available,
            alive=alive.copy(),
            reward=reward,
            terminated=np.array(terminated),
            truncated=np.array(truncated),
            measures=self.measures(infos, terminated or truncated),
        )

    def row(self, one: Agent, given: Any) -> Float[np.ndarray, " _"]:
        try:
            if one.masked and not (isinstance(given, Mapping) and {"observation", MASK} <= set(given)):
                raise ValueError(f"must have the parts observation and {MASK}, but is {shortened(given)}")
            return rows_of.flat(one.observation, given["observation"] if one.masked else given)
        except ValueError as error:
            raise LareError(f"environment {self.name!r}: the observation of {one.name} {self.where} {error}") from None

    def restrict(self, available: Bool[np.ndarray, " action"], one: Agent, given: Any, info: Any) -> None:
        """Apply the agent's mask, from the observation or from `info`, to `available`."""
        told = given[MASK] if one.masked else info.get(MASK) if isinstance(info, Mapping) else None
        if told is None:
            return
        try:
            if not one.discrete:
                raise ValueError(f"applies to {shortened(one.action)}, which is not discrete")
            available[: one.action_size] = rows_of.mask(told, one.action_size)
        except ValueError as error:
            raise LareError(f"environment {self.name!r}: the action mask of {one.name} {self.where} {error}") from None
        if self.looking:
            self.masks = True
        elif not self.masks:
            raise LareError(
                f"environment {self.name!r} gave {one.name} an action mask {self.where}, and had none at its first reset"
            )

    def state(self, observation: Float[np.ndarray, "agents observation"]) -> Float[np.ndarray, " state"]:
        """The environment's own state. Without one, all observations if steps are judged by the state, else an empty array."""
        if self.looking:
            self.last_state = self.own_state()
        elif self.last_state is not None:
            try:
                self.last_state = self.own_state(self.last_state.shape)
            except StateFault as error:
                self.stand_in(error)
        if self.last_state is not None:
            return self.last_state.ravel()
        return observation.ravel() if self.judged_from_state else np.zeros(0, np.float32)

    def own_state(self, shape: tuple[int, ...] | None = None) -> Float[np.ndarray, "..."] | None:
        if not callable(getattr(self.environment, "state", None)):
            return None
        try:
            value = self.environment.state()
        except (Exception, SystemExit) as error:
            if self.looking and isinstance(error, NotImplementedError):
                return None  # from PettingZoo's base class: the environment has no state
            raise StateFault(str(fault(f"environment {self.name!r} failed in state {self.where}", error))) from error
        try:
            return rows_of.finite(value, shape)
        except ValueError as error:
            raise LareError(f"environment {self.name!r}: the state {self.where} {error}") from None

    def stand_in(self, error: "StateFault") -> None:
        """Keep the previous state if only a critic needs it. Multiwalker, for example, has no state once an agent has fallen."""
        if self.judged_from_state:
            raise error
        if not self.told:
            logging.getLogger(__name__).warning("%s; the previous state is used instead", error)
        self.told = True

    def measures(self, infos: Mapping[Any, Any], last: bool) -> dict[str, Float[Numbers, ""]]:
        """The measures of the last step: means over the agents whose `info` has them."""
        return {name: np.array(self.measured(infos, name) if last else 0, np.float32) for name in self.task.measures}

    def measured(self, infos: Mapping[Any, Any], name: str) -> float:
        told = [info for info in infos.values() if isinstance(info, Mapping)]
        values = [info[name] for info in told if name in info]
        if not values:
            keys = ", ".join(sorted({str(key) for info in told for key in info}))
            raise LareError(f"the task measures {name!r}, but the last step's info has only {keys or 'nothing'}")
        what = f"the task measures {name!r}, and the last step's info has"
        return float(np.mean([number(value, what) for value in values]))
