"""The particle tasks as `JaxEnv`s: pure functions, which are compiled together with training."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from lare_rl.envs.interface import EnvSpec, Frame, Timestep
from lare_rl.envs.particles.catalogue import find_particle_task
from lare_rl.envs.particles.task import MAX_STEPS, N_ACTIONS
from lare_rl.envs.particles.world import State
from lare_rl.tasks.spec import TaskSpec

__all__ = ["ParticleEnv", "ParticleState", "make"]


def make(task: TaskSpec, **_: Any) -> "ParticleEnv":
    """Make the environment of a task with the name `particles/NAME`."""
    return ParticleEnv(task.name_in_family)


class ParticleState(NamedTuple):
    """The world, and the number of steps since the start of the episode."""

    world: State
    step: Int[Array, ""]


class ParticleEnv:
    """A particle task as a `JaxEnv`. The time limit terminates the episode: no rewards are expected after it."""

    def __init__(self, name: str):
        self.task = find_particle_task(name)
        self.spec = EnvSpec(
            teams=self.task.teams,
            observation_size=self.task.observation_size,
            action_size=N_ACTIONS,
            discrete=True,
            max_steps=MAX_STEPS,
            fixed_length=True,
            is_jax=True,
        )

    def reset(self, key: PRNGKeyArray) -> tuple[ParticleState, Timestep]:
        state = ParticleState(self.task.reset(key), jnp.zeros((), jnp.int32))
        return state, self._make_timestep(state, jnp.zeros(self.spec.n_agents))

    def step(
        self, state: ParticleState, action: Float[Array, "agents action"], key: PRNGKeyArray
    ) -> tuple[ParticleState, Timestep]:
        world = self.task.step(state.world, jnp.argmax(action, axis=-1), key)
        state = ParticleState(world, state.step + 1)
        return state, self._make_timestep(state, self.task.reward(world))

    def _make_timestep(self, state: ParticleState, reward: Float[Array, " agents"]) -> Timestep:
        agents = self.spec.n_agents
        return Timestep(
            observation=self.task.observe(state.world),
            state=jnp.zeros(0),
            available=jnp.ones((agents, N_ACTIONS), bool),
            alive=jnp.ones(agents, bool),
            reward=reward,
            terminated=state.step >= MAX_STEPS,
            truncated=jnp.zeros((), bool),
            measures={},
        )

    def frames(self, states: ParticleState, credit: Float[np.ndarray, "steps agents"] | None = None) -> list[Frame]:
        from lare_rl.envs.particles.drawing import draw_frames

        return draw_frames(self.task, np.asarray(states.world.position), credit)
