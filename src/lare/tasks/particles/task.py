"""What a particle task is: a world, and pure functions on its states that know nothing of batches."""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from lare.tasks.env import Team
from lare.tasks.particles.world import State, World, move, push

STEPS = 25
"""Length of every episode. Nothing ends one earlier."""
ACTIONS = 5
"""Stay, left (-x), right (+x), down (-y), up (+y)."""


@dataclass(frozen=True, eq=False)
class ParticleTask:
    """A task. Its functions may be compiled and mapped over states, actions and keys.

    The learning agents are the first entities of its world; entities that also move follow a script.

    >>> import jax
    >>> from lare.tasks.particles.table import find_particle_task
    >>> task = find_particle_task("CN-6")
    >>> state = task.reset(jax.random.key(0))
    >>> state = task.step(state, jnp.zeros(task.agents, int), jax.random.key(1))
    >>> task.observe(state).shape, task.reward(state).shape
    ((6, 26), (6,))
    """

    name: str
    teams: tuple[Team, ...]
    """All learning agents, in order."""
    observation_size: int
    radius: float
    """Agents start within ±radius; nothing keeps them there."""
    world: World
    reset: Callable[[PRNGKeyArray], State]
    """A state to start from."""
    observe: Callable[[State], Float[Array, "agents observation"]]
    """What each learning agent sees of a state."""
    reward: Callable[[State], Float[Array, " agents"]]
    """What each learning agent earns by a step that led to this state."""
    script: Callable[[State, PRNGKeyArray], Int[Array, " scripted"]] = lambda state, key: jnp.zeros(0, int)
    """The actions of those that move but do not learn."""

    @property
    def agents(self) -> int:
        return self.teams[-1].stop

    def step(self, state: State, action: Int[Array, " agents"], key: PRNGKeyArray) -> State:
        """All act at once. The key is for the script; a task without one makes no use of it."""
        every = jnp.concatenate([action, self.script(state, key)])
        return move(self.world, state, push(self.world, every))
