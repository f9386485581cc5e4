"""SMAX: StarCraft-like battles (Rutherford et al., JaxMARL, 2024) in JAX, as a `JaxEnv`.

    reward = 10 * (sum of the enemy's health lost in the step, as shares, / enemies + 1 if the step won the battle)

which is 10 times the reward of SMAX, so that the largest return of an episode is 20, as in SMAC (Samvelyan et al., 2019).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.envs.interface import EnvSpec, Frame, Team, Timestep
from lare_rl.envs.smax import battle as rules
from lare_rl.envs.smax.battle import ATTACK, Battle, alive, won
from lare_rl.envs.smax.enemy import Memory, choose_actions, init_memory
from lare_rl.envs.smax.observation import global_state, observation_size, observe, state_size
from lare_rl.envs.smax.scenarios import Scenario, find_scenario
from lare_rl.tasks.spec import TaskSpec

__all__ = ["SMAX", "WIN_RETURN", "SmaxState", "make", "reward"]

WIN_RETURN = 20.0
"""The return of an episode that is won."""


def make(task: TaskSpec, **_: Any) -> "SMAX":
    """Make the environment of a task with the name `smax/SCENARIO`."""
    return SMAX(task.environment_name)


class SmaxState(NamedTuple):
    """A battle, and the enemy's memory."""

    battle: Battle
    memory: Memory


class SMAX:
    """A battle in which the agents are the units of one side. A `JaxEnv`.

    The actions are up, right, down, left, stop, and one attack for each enemy unit. An action that is not available does nothing.
    A unit that dies leaves. All living units receive the same reward: the reward of their side.

    >>> env = SMAX("2s3z")
    >>> state, timestep = env.reset(jax.random.key(0))
    >>> state, timestep = env.step(state, jax.nn.one_hot(jnp.full(5, 1), 10), jax.random.key(1))
    >>> timestep.observation.shape, timestep.state.shape, float(timestep.measures["won"])
    ((5, 127), (120,), 0.0)
    """

    spec: EnvSpec
    scenario: Scenario

    def __init__(self, name: str):
        self.scenario = scenario = find_scenario(name)
        self.spec = EnvSpec(
            teams=(Team("ally", 0, scenario.n_allies),),
            observation_size=observation_size(scenario),
            action_size=ATTACK + scenario.n_enemies,
            discrete=True,
            max_steps=scenario.max_steps,
            state_size=state_size(scenario),
            agents_leave=True,
            masks_actions=True,
            is_jax=True,
            measures=("won",),
        )

    def reset(self, key: PRNGKeyArray) -> tuple[SmaxState, Timestep]:
        """Start a battle. Both armies have full health."""
        battle = rules.start_battle(self.scenario, key)
        state = SmaxState(battle, init_memory(self.scenario, battle))
        return state, self._make_timestep(battle, jnp.zeros(self.scenario.n_allies))

    def step(
        self, state: SmaxState, action: Float[Array, "agents action"], key: PRNGKeyArray
    ) -> tuple[SmaxState, Timestep]:
        """Make one step of half a second. Both sides choose from the same state."""
        scenario, battle = self.scenario, state.battle
        enemy_key, noise_key = jax.random.split(key)
        enemy_action, memory = choose_actions(scenario, battle, state.memory, enemy_key)
        joint_action = jnp.concatenate([jnp.argmax(action, axis=1).astype(jnp.int32), enemy_action])
        next_battle = rules.advance(scenario, battle, joint_action, rules.sample_cooldown_noise(noise_key, scenario))
        team_reward = reward(scenario, battle, next_battle)
        rewards = jnp.where(alive(battle)[: scenario.n_allies], team_reward, 0)
        return SmaxState(next_battle, memory), self._make_timestep(next_battle, rewards)

    def _make_timestep(self, battle: Battle, reward: Float[Array, " agents"]) -> Timestep:
        allies_defeated, enemies_defeated = rules.defeated(self.scenario, battle)
        return Timestep(
            observation=observe(self.scenario, battle),
            state=global_state(self.scenario, battle),
            available=rules.available_actions(self.scenario, battle),
            alive=alive(battle)[: self.scenario.n_allies],
            reward=reward,
            terminated=allies_defeated | enemies_defeated,
            truncated=battle.step >= self.scenario.max_steps,
            measures={"won": won(self.scenario, battle).astype(jnp.float32)},
        )

    def frames(self, states: SmaxState, credit: Float[np.ndarray, "steps agents"] | None = None) -> list[Frame]:
        from lare_rl.envs.smax.drawing import draw_frames

        if credit is not None:  # all living units have the same credit, dead units none
            credit = np.take_along_axis(credit, np.abs(credit).argmax(axis=1)[:, None], axis=1)[:, 0]
        return draw_frames(self.scenario, states.battle, credit)


def reward(scenario: Scenario, battle: Battle, next_battle: Battle) -> Float[Array, ""]:
    """Return the reward of our side for a step. A win counts once, even if the battle continues after it."""
    lost = (battle.health - next_battle.health) / scenario.unit_stats("health")
    harm = jnp.sum(lost[scenario.n_allies :]) / scenario.n_enemies
    return WIN_RETURN / 2 * (harm + (won(scenario, next_battle) & ~won(scenario, battle)))
