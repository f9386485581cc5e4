"""A mock of SMAC's StarCraft2Env, in which SMAX plays the battles."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from lare_rl.envs.smax.smax_env import SMAX

FROM_SMAC = (4, 4, 0, 2, 1, 3)
"""SMAX's numbers of no-op, stop, north, south, east and west."""


@cache
def compiled_smax(name: str):
    """Return a SMAX environment, and its compiled `reset` and `step`."""
    env = SMAX(name)
    return env, jax.jit(env.reset), jax.jit(env.step)


class FakeSmac:
    """Asserts what SMAC asserts. `crash_at` is the step in which the game crashes."""

    launched: tuple[int, ...] = ()

    def __init__(self, map_name: str, difficulty: str, seed: int, crash_at: int | None = None):
        assert difficulty == "7"
        type(self).launched += (seed,)
        self.env, self.start, self.advance = compiled_smax(map_name)
        self.key, self.crash_at = jax.random.key(seed), crash_at
        self.steps, self.closed, self.runs, self.ended = 0, False, False, False

    def get_env_info(self) -> dict[str, int]:
        spec = self.env.spec
        shapes = {"obs_shape": spec.observation_size, "state_shape": spec.state_size}
        counts = {"n_agents": spec.n_agents, "n_actions": spec.action_size + 1, "episode_limit": spec.max_steps}
        return shapes | counts

    def reset(self):
        assert not self.closed
        assert self.ended or not self.runs, "a second game is started"
        self.runs = True
        self.key, key = jax.random.split(self.key)
        (self.state, self.timestep), self.steps = self.start(key), 0
        return self.get_obs(), self.get_state()

    def get_obs(self) -> list[np.ndarray]:
        return list(np.asarray(self.timestep.observation))

    def get_state(self) -> np.ndarray:
        return np.asarray(self.timestep.state)

    def get_avail_actions(self) -> list[list[int]]:
        rows = []
        for alive, row in zip(self.timestep.alive, np.asarray(self.timestep.available, int), strict=True):
            # Actions of living agents are in SMAC's order. Dead agents have only the first one.
            moves = [0, *(row[i] for i in FROM_SMAC[1:])]
            rows.append([*moves, *row[5:]] if alive else [1] + [0] * len(row))
        return rows

    def step(self, actions: list[int]):
        assert all(type(action) is int for action in actions)
        assert all(row[action] for row, action in zip(self.get_avail_actions(), actions, strict=True)), "not available"
        self.steps += 1
        if self.steps == self.crash_at:
            return 0, True, {}
        self.key, key = jax.random.split(self.key)
        choice = jnp.array([FROM_SMAC[action] if action < 6 else action - 1 for action in actions])
        rows = jax.nn.one_hot(choice, self.env.spec.action_size)
        self.state, self.timestep = self.advance(self.state, rows, key)
        over = bool(self.timestep.terminated | self.timestep.truncated)
        self.ended = self.ended or over
        return float(self.timestep.reward.max()), over, {"battle_won": bool(self.timestep.measures["won"])}

    def close(self) -> None:
        self.closed = True

    def render(self, mode: str):
        assert mode == "rgb_array"
        return np.zeros((4, 4, 3), np.uint8)
