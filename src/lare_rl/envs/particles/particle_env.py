"""The particle tasks as `JaxEnv`s: pure functions, which are compiled together with training."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt8

from lare_rl.envs.interface import EnvSpec, Timestep
from lare_rl.envs.particles.catalogue import find_particle_task
from lare_rl.envs.particles.task import ACTIONS, STEPS
from lare_rl.envs.particles.world import State


class Moment(NamedTuple):
    """The world, and the number of steps so far."""

    world: State
    step: Int[Array, ""]


class ParticleJaxEnv:
    """A particle task as a `JaxEnv`. The time limit terminates the episode: no rewards are expected after it."""

    def __init__(self, name: str):
        self.task = find_particle_task(name)
        self.spec = EnvSpec(
            teams=self.task.teams,
            observation_size=self.task.observation_size,
            action_size=ACTIONS,
            discrete=True,
            max_steps=STEPS,
            fixed_length=True,
            in_jax=True,
        )

    def reset(self, key: PRNGKeyArray) -> tuple[Moment, Timestep]:
        """The first state and timestep of an episode."""
        moment = Moment(self.task.reset(key), jnp.zeros((), jnp.int32))
        return moment, self.timestep(moment, jnp.zeros(self.spec.agents))

    def step(self, state: Moment, action: Float[Array, "agents action"], key: PRNGKeyArray) -> tuple[Moment, Timestep]:
        """All agents act at once."""
        world = self.task.step(state.world, jnp.argmax(action, axis=-1), key)
        moment = Moment(world, state.step + 1)
        return moment, self.timestep(moment, self.task.reward(world))

    def timestep(self, moment: Moment, reward: Float[Array, " agents"]) -> Timestep:
        """The timestep of a state."""
        agents = self.spec.agents
        return Timestep(
            observation=self.task.observe(moment.world),
            state=jnp.zeros(0),
            available=jnp.ones((agents, ACTIONS), bool),
            alive=jnp.ones(agents, bool),
            reward=reward,
            terminated=moment.step >= STEPS,
            truncated=jnp.zeros((), bool),
            measures={},
        )

    def frames(
        self, states: Moment, credit: Float[np.ndarray, "steps agents"] | None = None
    ) -> list[UInt8[np.ndarray, "height width 3"]]:
        """An episode as pictures."""
        from lare_rl.envs.particles.drawing import frames

        return frames(self.task, np.asarray(states.world.position), credit)
