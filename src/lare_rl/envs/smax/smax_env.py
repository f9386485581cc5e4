"""SMAX: StarCraft-like battles (Rutherford et al., JaxMARL, 2024) in JAX, as a `JaxEnv`.

    reward = 10 * (sum of the enemy's health lost in the step, as shares, / enemies + 1 if the step won the battle)

which is 10 times the reward of SMAX, so that the largest return of an episode is 20, as in SMAC (Samvelyan et al., 2019).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, UInt8

from lare_rl.envs.interface import EnvSpec, Team, Timestep
from lare_rl.envs.smax.battle import ATTACK, Battle, advance, alive, defeated, legal, spread, start, won
from lare_rl.envs.smax.enemy import Memory, act, remember
from lare_rl.envs.smax.observation import field, observation_size, observe, state_size
from lare_rl.envs.smax.scenarios import Scenario, find_scenario

MOST = 20.0
"""The return of an episode that is won."""


class State(NamedTuple):
    """A battle, and the enemy's memory."""

    battle: Battle
    memory: Memory


class SMAX:
    """A battle in which the agents are the units of one side. A `JaxEnv`.

    The choices are up, right, down, left, stop, and one attack for each enemy unit. A choice that is not available does nothing.
    A unit that dies leaves. All living units receive the same reward: the reward of their side.

    >>> env = SMAX("2s3z")
    >>> state, seen = env.reset(jax.random.key(0))
    >>> state, seen = env.step(state, jax.nn.one_hot(jnp.full(5, 1), 10), jax.random.key(1))
    >>> seen.observation.shape, seen.state.shape, float(seen.measures["won"])
    ((5, 127), (120,), 0.0)
    """

    spec: EnvSpec
    scenario: Scenario

    def __init__(self, name: str):
        self.scenario = scenario = find_scenario(name)
        self.spec = EnvSpec(
            teams=(Team("ally", 0, scenario.allies),),
            observation_size=observation_size(scenario),
            action_size=ATTACK + scenario.enemies,
            discrete=True,
            max_steps=scenario.limit,
            state_size=state_size(scenario),
            agents_leave=True,
            masks_actions=True,
            in_jax=True,
            measures=("won",),
        )

    def reset(self, key: PRNGKeyArray) -> tuple[State, Timestep]:
        """Start a battle. Both armies have full health."""
        battle = start(self.scenario, key)
        return State(battle, remember(self.scenario, battle)), self.show(battle, jnp.zeros(self.scenario.allies))

    def step(self, state: State, action: Float[Array, "agents action"], key: PRNGKeyArray) -> tuple[State, Timestep]:
        """Both sides choose from the same state, and the battle continues for half a second."""
        enemy_key, battle_key = jax.random.split(key)
        theirs, memory = act(self.scenario, state.battle, state.memory, enemy_key)
        ours = jnp.argmax(action, axis=1).astype(jnp.int32)
        longer = spread(battle_key, self.scenario)
        battle = advance(self.scenario, state.battle, jnp.concatenate([ours, theirs]), longer)
        lived = alive(state.battle)[: self.scenario.allies]
        return State(battle, memory), self.show(
            battle, jnp.where(lived, reward(self.scenario, state.battle, battle), 0)
        )

    def show(self, battle: Battle, paid: Float[Array, " agents"]) -> Timestep:
        """The timestep of a battle after a step with the given rewards."""
        ours, theirs = defeated(self.scenario, battle)
        return Timestep(
            observation=observe(self.scenario, battle),
            state=field(self.scenario, battle),
            available=legal(self.scenario, battle),
            alive=alive(battle)[: self.scenario.allies],
            reward=paid,
            terminated=ours | theirs,
            truncated=battle.step >= self.scenario.limit,
            measures={"won": won(self.scenario, battle).astype(jnp.float32)},
        )

    def frames(
        self, states: State, credit: Float[np.ndarray, "steps agents"] | None = None
    ) -> list[UInt8[np.ndarray, "height width 3"]]:
        """An episode as pictures."""
        from lare_rl.envs.smax.drawing import frames

        if credit is not None:  # all living units have the same credit, dead units none
            credit = np.take_along_axis(credit, np.abs(credit).argmax(axis=1)[:, None], axis=1)[:, 0]
        return frames(self.scenario, states.battle, credit)


def reward(scenario: Scenario, before: Battle, after: Battle) -> Float[Array, ""]:
    """The reward of our side for a step. The win is only paid once, even if the battle is continued after it."""
    lost = (before.health - after.health) / scenario.each("health")
    harm = jnp.sum(lost[scenario.allies :]) / scenario.enemies
    return MOST / 2 * (harm + (won(scenario, after) & ~won(scenario, before)))
