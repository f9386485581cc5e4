"""Small environments of JAX whose score is a sum, an extreme, a final value, a chain of events, or won and lost by chance.

    corridor/SCORE       one agent on a line, from -1 to 1, which goes left, stays, or goes right for 40 steps
    levels/CN-6          cooperative navigation whose agents start inside, around or far outside the square of the landmarks

    scores/HalfCheetahScaled-v4     HalfCheetah-v4 with 0.3 of each reward
    scores/HalfCheetahSmoothed-v4   HalfCheetah-v4 with the mean of the last 10 rewards

In the corridor, a key lies at the left end, and a door at the right end opens only with the key. The scores:

    sum       the mean position
    highest   the largest position, less 0.02 for each move
    last      how close the last position is to 0.5
    door      1 if the door was opened, else 0
    odds      1 with the probability sigmoid(4 mean position - 3), else 0
"""

from collections import deque
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt8

from lare_rl.envs.families import register_family
from lare_rl.envs.interface import EnvSpec, Team, Timestep
from lare_rl.envs.load import read_task
from lare_rl.envs.particles.particle_env import ParticleEnv, ParticleState
from lare_rl.tasks.spec import TaskSpec

__all__ = ["SCORES", "corridor_task", "level_task"]

STEP, END, MAX_STEPS = 0.2, 0.8, 40
SCORES = ("sum", "highest", "last", "door", "odds")
N_LEVELS = 3


class CorridorState(NamedTuple):
    """Where the agent is, and what has happened."""

    position: Float[Array, ""]
    has_key: Bool[Array, ""]
    is_open: Bool[Array, ""]
    highest: Float[Array, ""]
    total: Float[Array, ""]
    n_moves: Float[Array, ""]
    time: Int[Array, ""]


class Corridor:
    """The corridor, with one of `SCORES` paid at the end."""

    def __init__(self, task: TaskSpec, **_: Any):
        self.score = task.name_in_family
        self.spec = EnvSpec(
            teams=(Team("agent", 0, 1),),
            observation_size=4,
            action_size=3,
            discrete=True,
            max_steps=MAX_STEPS,
            fixed_length=True,
            is_jax=True,
        )

    def reset(self, key: PRNGKeyArray) -> tuple[CorridorState, Timestep]:
        position = jax.random.uniform(key, minval=-0.2, maxval=0.2)
        no, zero = jnp.zeros((), bool), jnp.zeros(())
        state = CorridorState(position, no, no, position, zero, zero, jnp.zeros((), jnp.int32))
        return state, self._make_timestep(state, zero)

    def step(
        self, state: CorridorState, action: Float[Array, "agents action"], key: PRNGKeyArray
    ) -> tuple[CorridorState, Timestep]:
        move = jnp.argmax(action[0]) - 1
        position = jnp.clip(state.position + STEP * move, -1, 1)
        state = CorridorState(
            position,
            state.has_key | (position < -END),
            state.is_open | (state.has_key & (position > END)),
            jnp.maximum(state.highest, position),
            state.total + position,
            state.n_moves + (move != 0),
            state.time + 1,
        )
        mean = state.total / MAX_STEPS
        score = {
            "sum": mean,
            "highest": state.highest - 0.02 * state.n_moves,
            "last": 1 - jnp.abs(position - 0.5),
            "door": state.is_open.astype(jnp.float32),
            "odds": (jax.random.uniform(key) < jax.nn.sigmoid(4 * mean - 3)).astype(jnp.float32),
        }[self.score]
        return state, self._make_timestep(state, jnp.where(state.time == MAX_STEPS, score, 0))

    def _make_timestep(self, state: CorridorState, reward: Float[Array, ""]) -> Timestep:
        entries = state.position, state.has_key, state.is_open, state.time / MAX_STEPS
        return Timestep(
            observation=jnp.stack([jnp.asarray(entry, jnp.float32) for entry in entries])[None],
            state=jnp.zeros(0),
            available=jnp.ones((1, 3), bool),
            alive=jnp.ones(1, bool),
            reward=reward[None],
            terminated=state.time >= MAX_STEPS,
            truncated=jnp.zeros((), bool),
            measures={},
        )

    def frames(
        self, states: CorridorState, credit: Float[np.ndarray, "steps agents"] | None = None
    ) -> list[UInt8[np.ndarray, "height width 3"]]:
        """Draw the agent as a dark square on a light line."""
        frames = []
        for position in np.asarray(states.position):
            frame = np.full((16, 208, 3), 230, np.uint8)
            column = round(100 * (float(position) + 1))
            frame[4:12, column : column + 8] = 40
            frames.append(frame)
        return frames


class LevelState(NamedTuple):
    """A particle world, and the level of its episode."""

    inner: ParticleState
    level: Int[Array, ""]


class LevelEnv:
    """A particle task in three levels: agents start up to 1, 2 or 3 times as far from the centre."""

    def __init__(self, task: TaskSpec, **_: Any):
        self.inner = ParticleEnv(task.name_in_family)
        self.spec = EnvSpec(**{**vars(self.inner.spec), "measures": ("level",)})

    def reset(self, key: PRNGKeyArray) -> tuple[LevelState, Timestep]:
        level_key, key = jax.random.split(key)
        level = jax.random.randint(level_key, (), 0, N_LEVELS)
        state, timestep = self.inner.reset(key)
        is_agent = jnp.arange(len(state.world.position)) < self.spec.n_agents
        scale = jnp.where(is_agent, 1.0 + level, 1)[:, None]
        world = state.world._replace(position=scale * state.world.position)
        state = state._replace(world=world)
        timestep = timestep._replace(observation=self.inner.task.observe(world))
        return LevelState(state, level), self._with_level(timestep, level)

    def step(
        self, state: LevelState, action: Float[Array, "agents action"], key: PRNGKeyArray
    ) -> tuple[LevelState, Timestep]:
        inner, timestep = self.inner.step(state.inner, action, key)
        return LevelState(inner, state.level), self._with_level(timestep, state.level)

    def frames(
        self, states: LevelState, credit: Float[np.ndarray, "steps agents"] | None = None
    ) -> list[UInt8[np.ndarray, "height width 3"]]:
        return self.inner.frames(states.inner, credit)

    def _with_level(self, timestep: Timestep, level: Int[Array, ""]) -> Timestep:
        return timestep._replace(measures={"level": level.astype(jnp.float32)})


class SmoothedReward(gymnasium.Wrapper):
    """Pay the mean of the rewards of the last steps."""

    def __init__(self, env: gymnasium.Env, n_steps: int):
        super().__init__(env)
        self.rewards: deque[float] = deque(maxlen=n_steps)

    def reset(self, **arguments: Any) -> tuple[Any, dict[str, Any]]:
        self.rewards.clear()
        return self.env.reset(**arguments)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.rewards.append(float(reward))
        return observation, float(np.mean(self.rewards)), terminated, truncated, info


def make_scaled(**arguments: Any) -> gymnasium.Env:
    return gymnasium.wrappers.TransformReward(
        gymnasium.make("HalfCheetah-v4", **arguments), lambda reward: 0.3 * float(reward)
    )


def make_smoothed(**arguments: Any) -> gymnasium.Env:
    return SmoothedReward(gymnasium.make("HalfCheetah-v4", **arguments), 10)


gymnasium.register("scores/HalfCheetahScaled-v4", make_scaled)
gymnasium.register("scores/HalfCheetahSmoothed-v4", make_smoothed)
register_family("corridor", Corridor, single_agent=True)
register_family("levels", LevelEnv, score="sum")


def corridor_task(name: str, **keys: Any) -> TaskSpec:
    """Return the task of one of `SCORES`."""
    return TaskSpec(
        name=f"Corridor-{name}",
        environment=f"corridor/{name}",
        description="An agent walks along a corridor with a key and a door.",
        observation="0: the position\n1: has the key\n2: the door is open\n3: the time",
        action="left, stay or right",
        observation_size=4,
        action_size=3,
        **keys,
    )


def level_task(name: str, *, grouped: bool) -> TaskSpec:
    """Return a particle task in levels, whose episodes belong to groups or do not."""
    task = read_task(name)
    return task.model_copy(
        update={"environment": f"levels/{name}", "name": f"{name}-levels", "group": "level" if grouped else None}
    )
