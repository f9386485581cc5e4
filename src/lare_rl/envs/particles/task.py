"""The definition of a particle task: a world, and pure functions on a state without a batch axis."""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from lare_rl.envs.interface import Team
from lare_rl.envs.particles.world import State, World, move, push

__all__ = ["MAX_STEPS", "N_ACTIONS", "ParticleTask"]

MAX_STEPS = 25
"""The length of every episode. No episode ends earlier."""
N_ACTIONS = 5
"""Stay, left (-x), right (+x), down (-y), up (+y)."""


@dataclass(frozen=True, eq=False)
class ParticleTask:
    """A task, whose functions can be compiled and mapped over states, actions and keys.

    The learning agents are the first entities of its world. Other moving entities follow a script.

    >>> import jax
    >>> from lare_rl.envs.particles.catalogue import find_particle_task
    >>> task = find_particle_task("CN-6")
    >>> state = task.reset(jax.random.key(0))
    >>> state = task.step(state, jnp.zeros(task.n_agents, int), jax.random.key(1))
    >>> task.observe(state).shape, task.reward(state).shape
    ((6, 26), (6,))
    """

    name: str
    teams: tuple[Team, ...]
    """All learning agents, in order."""
    observation_size: int
    half_side: float
    """Agents start within ±half_side, but may leave this square."""
    world: World
    reset: Callable[[PRNGKeyArray], State]
    """The first state of an episode."""
    observe: Callable[[State], Float[Array, "agents observation"]]
    """Each learning agent's observation of a state."""
    reward: Callable[[State], Float[Array, " n_agents"]]
    """Each learning agent's reward for a step that led to this state."""
    script: Callable[[State, PRNGKeyArray], Int[Array, " scripted"]] = lambda state, key: jnp.zeros(0, int)
    """The actions of entities that move but do not learn."""

    @property
    def n_agents(self) -> int:
        return self.teams[-1].stop

    def step(self, state: State, action: Int[Array, " n_agents"], key: PRNGKeyArray) -> State:
        """Make one step, in which all agents act at once. Only the script uses the key."""
        all_actions = jnp.concatenate([action, self.script(state, key)])
        return move(self.world, state, push(self.world, all_actions))
