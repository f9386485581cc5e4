"""A stub of SMAC's StarCraft2Env, which asserts what SMAC asserts."""

from typing import Any

import numpy as np


class FakeSmac:
    """Two units. The second unit dies in the first step. `results` is an iterator over the results of the steps, also of later games."""

    launched: tuple[int, ...] = ()

    def __init__(self, map_name: str, difficulty: str, seed: int, results: Any = ()):
        assert (map_name, difficulty) == ("2s3z", "7")
        type(self).launched += (seed,)
        self.results, self.steps, self.runs, self.has_ended = results, 0, False, False

    def get_env_info(self) -> dict[str, int]:
        return {"n_agents": 2, "n_actions": 3, "obs_shape": 4, "state_shape": 5, "episode_limit": 3}

    def reset(self) -> None:
        assert self.has_ended or not self.runs, "a second game is started"
        self.steps, self.runs = 0, True

    def get_obs(self) -> list[np.ndarray]:
        return [np.full(4, 10 * unit + self.steps) for unit in (1, 2)]

    def get_state(self) -> np.ndarray:
        return np.full(5, self.steps)

    def get_avail_actions(self) -> list[list[int]]:
        return [[0, 1, 1], [1, 0, 0] if self.steps else [0, 1, 0]]

    def step(self, actions: list[int]) -> Any:
        assert all(type(action) is int for action in actions)
        assert all(row[action] for row, action in zip(self.get_avail_actions(), actions, strict=True)), "not available"
        self.steps += 1
        reward, done, info = next(self.results)
        self.has_ended = self.has_ended or bool(done and info)  # without info, the game has crashed
        return reward, done, info

    def close(self) -> None:
        self.runs, self.has_ended = True, False

    def render(self, mode: str) -> np.ndarray:
        assert mode == "rgb_array"
        return np.zeros((4, 4, 3), np.uint8)
