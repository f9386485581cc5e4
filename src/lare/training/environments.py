"""Environments on the host: one for each seed, stepped by actions in [-1, 1], with everything that they give checked."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from jaxtyping import Float, Int

from lare.errors import LareError, shortened
from lare.tasks.environment import make, number
from lare.tasks.episodic import TRUE_REWARD, EpisodicReward
from lare.tasks.spaces import Choice
from lare.tasks.spec import TaskSpec
from lare.training.replay import Step

Policy = Callable[[Float[np.ndarray, "seeds *episodes observation"]], Float[np.ndarray, "seeds *episodes action"]]

Explorer = Callable[
    [Float[np.ndarray, "seeds observation"], Float[np.ndarray, "seeds action"]], Float[np.ndarray, "seeds action"]
]
"""From observations and noise to actions."""


class Stream(IntEnum):
    """What random numbers are for. Each use has numbers of its own, whatever the others consume."""

    TRAINING_EPISODES = 0
    EXPLORATION = 1
    EVALUATION_EPISODES = 2
    FIT = 3
    UPDATE = 4


class EnvironmentFault(LareError):
    """An environment gave something that cannot be trained on."""


class Diverged(LareError):
    """What is being trained is not finite any more."""


def generator(seed: int, stream: Stream, number: int) -> np.random.Generator:
    """Random numbers that depend on nothing but these three: there is no state to save."""
    return np.random.default_rng([seed, stream, number])


def episode_seed(seed: int, stream: Stream, episode: int) -> int:
    return int(generator(seed, stream, episode).integers(2**31))


def make_episodic(task: TaskSpec, **kwargs: Any) -> EpisodicReward:
    """The task's environment, paying at the end; `kwargs` go to its constructor."""
    return EpisodicReward(make(task.environment, task.max_episode_steps, **kwargs))


def to_bounds(action: Float[np.ndarray, " action"], space: gymnasium.Space) -> Float[np.ndarray, " action"]:
    """From [-1, 1] (what lies beyond is the bound) to the environment's units, or to the choice of the largest number."""
    assert isinstance(space, Box)
    if isinstance(space, Choice):
        return space.chosen(action)
    scaled = space.low + (np.clip(action, -1, 1) + 1) / 2 * (space.high - space.low)
    precise = np.result_type(space.dtype, np.float32)
    return np.clip(scaled, space.low, space.high, dtype=precise)  # rounding may have led beyond the bounds


@dataclass
class Lane:
    """The training environment of one seed, and the episode that is under way in it."""

    seed: int
    environment: EpisodicReward
    episode: int = -1
    observation: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))
    actions: list[np.ndarray] = field(default_factory=list)
    """Of this episode, in the environment's units: with its seed, all that it takes to be here again."""

    def begin(self) -> None:
        """Start the next episode."""
        self.episode += 1
        self.actions = []
        seed = episode_seed(self.seed, Stream.TRAINING_EPISODES, self.episode)
        observation, _ = self.environment.reset(seed=seed)
        self.observation = self.checked(observation)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, np.ndarray, bool, bool]:
        """One step; returns observation, action, true reward, next observation, terminated, ended."""
        before, taken = self.observation, to_bounds(action, self.environment.action_space)
        after, _, terminated, truncated, info = self.environment.step(taken)
        self.actions.append(taken)
        reward = float(row(info[TRUE_REWARD], "reward", (), self.place))
        self.observation = self.checked(after)
        return before, taken, reward, self.observation, bool(terminated), bool(terminated or truncated)

    @property
    def place(self) -> str:
        return f"at step {len(self.actions)} of episode {self.episode} of seed {self.seed}"

    def checked(self, observation: object) -> Float[np.ndarray, " observation"]:
        return row(observation, "observation", self.environment.observation_space.shape, self.place)

    def replay(self, actions: Sequence[np.ndarray], observation: np.ndarray) -> bool:
        """Get into the middle of the current episode again, by its seed and actions.

        Returns whether that led to `observation`, bit for bit; an environment that is not deterministic does not.
        """
        self.episode -= 1
        self.begin()
        for action in actions:
            after, _, terminated, truncated, _ = self.environment.step(action)
            self.actions.append(action)
            self.observation = self.checked(after)
            if terminated or truncated:
                return False
        return np.array_equal(self.observation, observation)


def row(value: object, what: str, shape: tuple[int, ...] | None, where: str) -> np.ndarray:
    """What an environment gave, as a row of its own. Raises `EnvironmentFault` where nothing can be learned from it."""
    try:
        array = np.array(value, np.float32)  # a copy: the environment may write the next one into the same memory
    except (TypeError, ValueError):
        raise EnvironmentFault(f"the environment gave {shortened(value)} for its {what}, {where}") from None
    if array.shape != shape:
        raise EnvironmentFault(f"the environment gave its {what} in shape {array.shape}, not {shape}, {where}")
    if not np.isfinite(array).all():
        raise EnvironmentFault(f"the environment gave {array[~np.isfinite(array)][0]} in its {what}, {where}")
    return array


def check_finite(actions: Float[np.ndarray, "seeds *episodes action"], seeds: Sequence[int]) -> None:
    """Raise `Diverged` where a policy has become NaN: the environment, which would answer in kind, is not to blame."""
    for seed, chosen in zip(seeds, actions, strict=True):
        if not np.isfinite(chosen).all():
            raise Diverged(
                f"training diverged: the policy of seed {seed} is not finite any more; the last checkpoint is whole"
            )


@dataclass(frozen=True)
class Collected:
    """Some steps of every seed. Actions as the policy chose them, and, for `phi`, in the environment's units."""

    steps: Step
    environment_action: Float[np.ndarray, "seeds time action"]


def collect(lanes: Sequence[Lane], explore: Explorer, noise: Float[np.ndarray, "time seeds action"]) -> Collected:
    """Let the policy act for as many steps as there is noise."""
    rows: list[list[tuple]] = [[] for _ in lanes]
    for disturbance in noise:
        observation = np.stack([lane.observation for lane in lanes])
        actions = explore(observation, disturbance)
        check_finite(actions, [lane.seed for lane in lanes])
        for lane, action, row in zip(lanes, actions, rows, strict=True):
            row.append((action, *lane.step(action)))
            if row[-1][-1]:
                lane.begin()
    action, before, taken, reward, after, terminated, ended = (
        np.asarray([[step[column] for step in row] for row in rows]) for column in range(7)
    )
    no_factors = np.zeros((*reward.shape, 0), np.float32)
    steps = Step(before, action, no_factors, reward.astype(np.float32), after, terminated, ended)
    return Collected(steps, taken)


@dataclass(frozen=True)
class Evaluation:
    """What episodes of the deterministic policy gave."""

    returns: Float[np.ndarray, "seeds episodes"]
    lengths: Int[np.ndarray, "seeds episodes"]
    """In steps."""
    measures: dict[str, Float[np.ndarray, "seeds episodes"]]
    """What the task asks to be taken from the last step's `info`."""


def evaluate(
    environments: Sequence[Sequence[EpisodicReward]],
    policy: Policy,
    seeds: Sequence[int],
    measures: Sequence[str] = (),
    first: int = 0,
) -> Evaluation:
    """One episode in each environment (seeds, episodes), all in lockstep, each from a start of its own.

    The starts depend on seed and place only, which are counted from `first`: every evaluation of a run begins from the same
    ones, and none of them is a start of a training episode.
    """
    shape = (len(environments), len(environments[0]))
    places = list(np.ndindex(shape))

    def checked(observation: object, seed: int, environment: EpisodicReward) -> Float[np.ndarray, " observation"]:
        return row(observation, "observation", environment.observation_space.shape, f"in an evaluation of seed {seed}")

    def begun(environment: EpisodicReward, seed: int, place: int) -> Float[np.ndarray, " observation"]:
        start = episode_seed(seed, Stream.EVALUATION_EPISODES, place)
        return checked(environment.reset(seed=start)[0], seed, environment)

    observation = np.stack(
        [
            [begun(environment, seed, place) for place, environment in enumerate(of_seed, start=first)]
            for seed, of_seed in zip(seeds, environments, strict=True)
        ]
    )
    returns, lengths = np.full(shape, np.nan), np.zeros(shape, int)
    found = {name: np.full(shape, np.nan) for name in measures}
    while np.isnan(returns).any():
        actions = policy(observation)
        check_finite(actions, seeds)
        for place in places:
            if not np.isnan(returns[place]):
                continue
            environment = environments[place[0]][place[1]]
            after, paid, terminated, truncated, info = environment.step(
                to_bounds(actions[place], environment.action_space)
            )
            observation[place] = checked(after, seeds[place[0]], environment)
            lengths[place] += 1
            if terminated or truncated:
                if not np.isfinite(paid):
                    raise EnvironmentFault(f"the environment paid {paid} in an evaluation of seed {seeds[place[0]]}")
                returns[place] = paid
                for name in measures:
                    found[name][place] = measured(info, name)
    return Evaluation(returns, lengths, found)


def measured(info: dict, name: str) -> float:
    if name not in info:
        raise LareError(f"the task measures {name!r}, but the last step's info has only {', '.join(sorted(info))}")
    return number(info[name], f"the task measures {name!r}, and the last step's info has")
