"""Trains: several trains on a map of single and double tracks, each with a timetable. Delays are known at the end.

Flatland (Mohanty et al., 2020). A train is late, or does not arrive at all, because of what another one did much earlier.
"""

import functools
import gc
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from pettingzoo import ParallelEnv

from final_score.options import Pay, Policy, Split, check_option
from final_score.picture import new_figure, to_pixels

__all__ = ["RULES", "Trains", "parallel_env", "proxy_env", "test_env"]

N_TRAINS, SIZE = 5, 25
MAX_STEPS = 200
"""Flatland chooses the length by the map: 39 to 94 steps on those that were tried."""
MAPS = {"train": (0, 1000), "test": (1000, 1100)}
"""The first number of a map, and the end of the numbers."""
DIRECTIONS = ("L", "F", "R")
STOP = 3
"""The action after those of `DIRECTIONS`."""
FLATLAND_ACTIONS = (1, 2, 3, 4)
CLEAR_EVERY = 20
"""Flatland's caches are cleared whenever an environment has played this many episodes."""
TRAIN_ENTRIES, BRANCH_ENTRIES = 8, 5
DISTANCE, DETOUR = 50.0, 25.0
"""Distances (cells), times (steps) and detours (cells) are observed divided by these."""


class Trains(ParallelEnv):
    """Five trains on a new map in each episode. All agents stay until the end.

    Args:
        split: which maps are played: 1,000 or 100 others.
        pay: "end" pays each train Flatland's reward at the end: minus the time steps by which it is late, or minus those of its
            whole journey if it never left; "proxy" pays a tenth of the cells by which a train came closer to its target, in each
            step. The proxy does not add up to the score.
        render_mode: "rgb_array" or None.
    """

    metadata = {"name": "trains_v0", "render_modes": ["rgb_array"], "render_fps": 6}  # noqa: RUF012
    max_cycles = MAX_STEPS

    def __init__(self, split: Split = "train", pay: Pay = "end", render_mode: str | None = None):
        self._maps = MAPS[check_option("split", split, ("train", "test"))]
        self._pays_proxy = check_option("pay", pay, ("end", "proxy")) == "proxy"
        self.render_mode = render_mode
        self.possible_agents = [f"train_{index}" for index in range(N_TRAINS)]
        self.agents: list[str] = []
        size = TRAIN_ENTRIES + len(DIRECTIONS) * BRANCH_ENTRIES
        self.observation_spaces = {
            agent: gymnasium.spaces.Box(-1.0, 1.0, (size,), np.float32) for agent in self.possible_agents
        }
        self.action_spaces = {agent: gymnasium.spaces.Discrete(len(FLATLAND_ACTIONS)) for agent in self.possible_agents}
        self._rail = make_rail()
        self._n_episodes = 0
        self._random = np.random.default_rng()

    def observation_space(self, agent: str) -> gymnasium.Space:
        """Return what a train observes."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gymnasium.Space:
        """Return what a train can do: turn to the leftmost track, go on, turn to the rightmost track, stop."""
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin on a map. `options={"map": 7}` chooses it."""
        self._n_episodes += 1
        if self._n_episodes % CLEAR_EVERY == 0:
            for cache in flatland_caches():
                cache.cache_clear()
        if seed is not None:
            self._random = np.random.default_rng(seed)
        map_number = int(self._random.integers(*self._maps))
        self._map = int((options or {}).get("map", map_number))
        trees, _ = self._rail.reset(regenerate_rail=True, regenerate_schedule=True, random_seed=self._map)
        self.agents = list(self.possible_agents)
        self._distances = self._read_distances()
        return self._observe(trees), {agent: {"map": self._map} for agent in self.agents}

    def step(self, actions: dict[str, Any]):
        """Move all trains by a time step."""
        commands = {index: FLATLAND_ACTIONS[int(actions[agent])] for index, agent in enumerate(self.possible_agents)}
        trees, rewards, ends, _ = self._rail.step(commands)
        distances, ended = self._read_distances(), bool(ends["__all__"])
        progress = (self._distances - distances) / 10
        self._distances = distances
        infos: dict[str, dict[str, Any]] = {
            agent: {"proxy": float(progress[index])} for index, agent in enumerate(self.agents)
        }
        if ended:
            delays = [-float(rewards[index]) for index in range(N_TRAINS)]
            summary = {
                "score": -float(np.mean(delays)),
                "arrived": float(np.mean([train.arrival_time is not None for train in self._rail.agents])),
                "map": self._map,
            }
            infos = {agent: {**infos[agent], **summary, "delay": delays[i]} for i, agent in enumerate(self.agents)}
        rewarded = {
            agent: infos[agent]["proxy"] if self._pays_proxy else -infos[agent]["delay"] if ended else 0.0
            for agent in self.agents
        }
        observations, agents = self._observe(trees), self.agents
        self.agents = [] if ended else agents
        return observations, rewarded, dict.fromkeys(agents, ended), dict.fromkeys(agents, False), infos

    def render(self):
        """Draw tracks, trains and their targets."""
        figure = new_figure(4.0, 4.0)
        axes = figure.subplots()
        rows, columns = np.nonzero(self._rail.rail.grid)
        axes.scatter(columns, rows, marker="s", s=22, color="lightgrey", linewidths=0)
        for index, train in enumerate(self._rail.agents):
            row, column = next(iter(train.targets))[0]
            axes.scatter(column, row, marker="*", s=90, color=f"C{index}")
            if train.current_configuration is not None:
                row, column = train.current_configuration[0]
                axes.scatter(column, row, marker="o", s=45, color=f"C{index}", edgecolors="black")
        axes.set(xlim=(-1, SIZE), ylim=(SIZE, -1), aspect="equal", title=f"map {self._map}")
        axes.axis("off")
        return to_pixels(figure)

    def close(self) -> None:
        """Nothing is open."""

    def _read_distances(self) -> np.ndarray:
        """Return the distance of each train to its target (cells along the tracks)."""
        distance_map = self._rail.distance_map.get()
        distances = np.zeros(N_TRAINS)
        for index, train in enumerate(self._rail.agents):
            if train.arrival_time is None:
                (row, column), direction = train.current_configuration or train.initial_configuration
                distance = distance_map[index, row, column, direction]
                distances[index] = distance if np.isfinite(distance) else 2 * SIZE
        return distances

    def _observe(self, trees: Any) -> dict[str, np.ndarray]:
        from flatland.envs.step_utils.states import TrainState

        now, end = self._rail._elapsed_steps, self._rail._max_episode_steps
        observations = {}
        for index, (agent, train) in enumerate(zip(self.possible_agents, self._rail.agents, strict=True)):
            arrived = train.arrival_time is not None
            slack = 0.0 if arrived else train.latest_arrival - now - self._distances[index]
            entries = [
                float(train.state in (TrainState.WAITING, TrainState.READY_TO_DEPART)),
                float(train.state == TrainState.MOVING),
                float(train.state == TrainState.STOPPED),
                float(arrived),
                (end - now) / DISTANCE,
                slack / DISTANCE,
                max(0.0, train.earliest_departure - now) / DISTANCE,
                self._distances[index] / DISTANCE,
                *branch_entries(None if arrived else trees.get(index), self._distances[index]),
            ]
            observations[agent] = np.clip(np.array(entries, np.float32), -1.0, 1.0)
        return observations


def branch_entries(tree: Any, distance: float) -> list[float]:
    """Return for the branch in each direction: whether it exists, the detour to the target, how near the next train on it is, and the
    shares of trains that come from the other end and that run ahead.
    """
    entries: list[float] = []
    for direction in DIRECTIONS:
        branch = tree.childs[direction] if tree is not None and tree.childs else None
        if branch is None or isinstance(branch, float):
            entries += [0.0] * BRANCH_ENTRIES
            continue
        to_target = float(branch.dist_min_to_target)
        detour = to_target + float(branch.dist_to_next_branch) - distance if np.isfinite(to_target) else np.inf
        nearest = min(float(branch.dist_other_agent_encountered), float(branch.dist_potential_conflict))
        entries += [
            1.0,
            float(np.clip(detour / DETOUR, 0.0, 1.0)),
            1 / (1 + nearest) if nearest > 0 else 0.0,
            branch.num_agents_opposite_direction / N_TRAINS,
            branch.num_agents_same_direction / N_TRAINS,
        ]
    return entries


def make_rail() -> Any:
    """Return Flatland's environment."""
    from flatland.envs.line_generators import sparse_line_generator
    from flatland.envs.observations import TreeObsForRailEnv
    from flatland.envs.predictions import ShortestPathPredictorForRailEnv
    from flatland.envs.rail_env import RailEnv
    from flatland.envs.rail_generators import sparse_rail_generator

    return RailEnv(
        width=SIZE,
        height=SIZE,
        number_of_agents=N_TRAINS,
        rail_generator=sparse_rail_generator(max_num_cities=2),
        line_generator=sparse_line_generator(),
        obs_builder_object=TreeObsForRailEnv(max_depth=1, predictor=ShortestPathPredictorForRailEnv(20)),
    )


@functools.cache
def flatland_caches() -> tuple[Any, ...]:
    """Return Flatland's caches of pure functions of a map. They hold up to four million entries each, so memory would grow by 2 MB
    with every episode.
    """
    caches = (item for item in gc.get_objects() if isinstance(item, functools._lru_cache_wrapper))
    return tuple(cache for cache in caches if str(getattr(cache, "__module__", "")).startswith("flatland."))


def parallel_env(**arguments: Any) -> Trains:
    """Return the task with training maps. See `Trains`."""
    return Trains(**arguments)


def test_env(**arguments: Any) -> Trains:
    """Return the task with held-out maps."""
    return Trains(split="test", **arguments)


def proxy_env(**arguments: Any) -> Trains:
    """Return the task that pays the proxy."""
    return Trains(pay="proxy", **arguments)


def shortest_path(env: ParallelEnv) -> Policy:
    """Go on along the shortest path, whatever happens."""

    def policy(observation: np.ndarray) -> int:
        branches = observation[TRAIN_ENTRIES:].reshape(len(DIRECTIONS), BRANCH_ENTRIES)
        return int(np.argmin(branches[:, 1] + 2 * (branches[:, 0] == 0))) if branches[:, 0].any() else 1

    return policy


def wait_while_blocked(env: ParallelEnv) -> Policy:
    """Take the shortest path among the branches without a train from the other end; if there is none, wait."""

    def policy(observation: np.ndarray) -> int:
        branches = observation[TRAIN_ENTRIES:].reshape(len(DIRECTIONS), BRANCH_ENTRIES)
        costs = branches[:, 1] + 2 * (branches[:, 0] == 0) + 2 * (branches[:, 3] > 0)
        return int(np.argmin(costs)) if costs.min() < 2 else STOP

    return policy


RULES: dict[str, Callable[[ParallelEnv], Policy]] = {
    "wait while blocked": wait_while_blocked,
    "shortest path": shortest_path,
}
"""Rules of thumb by name, for each train."""
