"""SMAX: StarCraft-like battles (Rutherford et al., JaxMARL, 2024) in JAX, as a `JaxEnv`.

    reward = 10 * (harm + win)

harm is the mean share of their health that the enemy's units lose in the step; win is 1 in the step that wins the battle, else 0. This is
10 times the reward of SMAX, so that the largest return of an episode is 20, as in SMAC (Samvelyan et al., 2019).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.envs.interface import EnvSpec, Frame, Team, Timestep
from lare_rl.envs.smax import battle as rules
from lare_rl.envs.smax.battle import ATTACK, FIELD, Battle, alive, move_direction, won
from lare_rl.envs.smax.enemy import Memory, choose_actions, init_memory
from lare_rl.envs.smax.scenarios import Scenario, find_scenario
from lare_rl.tasks.spec import TaskSpec

__all__ = ["SMAX", "WIN_RETURN", "SmaxState", "global_state", "make", "observe", "reward"]

WIN_RETURN = 20.0
"""The return of an episode that is won."""


def make(task: TaskSpec, **_: Any) -> "SMAX":
    """Make the environment of a task with the name `smax/SCENARIO`."""
    return SMAX(task.name_in_family)


class SmaxState(NamedTuple):
    """A battle, and the enemy's memory."""

    battle: Battle
    memory: Memory


class SMAX:
    """A battle in which the agents are the units of one side. A `JaxEnv`.

    The actions are those of `battle.py`: four moves, stop, and one attack for each enemy unit. An attack that is not available hits if its
    target comes into reach during the step. A unit that dies leaves. All living units receive the same reward: the reward of their side.

    >>> env = SMAX("2s3z")
    >>> state, timestep = env.reset(jax.random.key(0))
    >>> state, timestep = env.step(state, jax.nn.one_hot(jnp.full(5, 1), 10), jax.random.key(1))
    >>> timestep.observation.shape, timestep.state.shape, float(timestep.measures["won"])
    ((5, 127), (120,), 0.0)
    """

    def __init__(self, name: str):
        self.scenario = scenario = find_scenario(name)
        self.spec = EnvSpec(
            teams=(Team("ally", 0, scenario.n_allies),),
            observation_size=(scenario.n_units - 1) * (7 + scenario.n_unit_types) + 4 + scenario.n_unit_types,
            action_size=ATTACK + scenario.n_enemies,
            discrete=True,
            max_steps=scenario.max_steps,
            state_size=scenario.n_units * (6 + scenario.n_unit_types),
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
        """Make one step. Both sides choose from the same state."""
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

        if credit is not None:  # one number for a step: the team's credit or, if each unit has its own, the largest one
            credit = np.take_along_axis(credit, np.abs(credit).argmax(axis=1)[:, None], axis=1)[:, 0]
        return draw_frames(self.scenario, states.battle, credit)


def reward(scenario: Scenario, battle: Battle, next_battle: Battle) -> Float[Array, ""]:
    """Return the reward of our side for a step. A win counts once, even if the battle continues after it."""
    lost = (battle.health - next_battle.health) / scenario.unit_stats("health")
    harm = jnp.sum(lost[scenario.n_allies :]) / scenario.n_enemies
    return WIN_RETURN / 2 * (harm + (won(scenario, next_battle) & ~won(scenario, battle)))


# Observations and state, with the layout of JaxMARL's SMAX


def _one_hot_unit_types(scenario: Scenario) -> Float[np.ndarray, "units unit_types"]:
    return np.eye(scenario.n_unit_types, dtype=np.float32)[scenario.unit_type]


def observe(scenario: Scenario, battle: Battle) -> Float[Array, "allies observation"]:
    """Return the observation of each of our units: all other units, ours first, and then the unit itself.

    For another unit: health as a share, offset in units of the observer's sight (x, y), its previous move (x, y), the number of its
    previous action divided by the largest action number if that was an attack (else 0), cooldown as a share between 0 and 1, type as
    one-hot; zeros if it is dead or not in sight.
    For the unit itself: health, position as a share of the field (x, y), cooldown, type. Dead units observe zeros.
    """
    n_allies, n_units = scenario.n_allies, scenario.n_units
    is_alive, unit_types = alive(battle), _one_hot_unit_types(scenario)
    health = (battle.health / scenario.unit_stats("health"))[:, None]
    cooldown = jnp.clip(battle.cooldown / scenario.unit_stats("cooldown"), 0, 1)[:, None]
    largest_action = ATTACK - 1 + np.where(scenario.is_enemy == 1, n_allies, scenario.n_enemies).astype(np.float32)
    attack = (jnp.where(battle.action >= ATTACK, battle.action, 0) / largest_action)[:, None]

    # Offsets differ between observers; all other values of a unit are the same for every observer.
    offset = battle.position - battle.position[:n_allies, None]
    visible = rules.within(scenario, battle, "sight")[:n_allies]
    sight = scenario.unit_stats("sight")[:n_allies, None]
    action_and_type = jnp.concatenate([move_direction(battle.action), attack, cooldown, unit_types], axis=1)
    columns = [health[None], offset / sight[..., None], action_and_type[None]]
    other_units = jnp.concatenate(
        [jnp.broadcast_to(column, (n_allies, n_units, column.shape[-1])) for column in columns], axis=2
    )
    other_units = jnp.where(visible[..., None], other_units, 0)
    # Leave out the observer itself: from its place on, each place holds the next unit.
    is_before = np.arange(n_units - 1) < np.arange(n_allies)[:, None]
    other_units = jnp.where(is_before[..., None], other_units[:, :-1], other_units[:, 1:])

    self_features = jnp.concatenate([health, battle.position / FIELD, cooldown, unit_types], axis=1)
    self_features = jnp.where(is_alive[:, None], self_features, 0)[:n_allies]
    return jnp.concatenate([other_units.reshape(n_allies, -1), self_features], axis=1)


def global_state(scenario: Scenario, battle: Battle) -> Float[Array, " state"]:
    """Return the global state.

    For each unit: health as a share, position (x, y), cooldown in seconds, type as one-hot; all are zeros once it is dead. Then the
    side of each unit (1 for the enemy's), and the type of each unit as a number.
    """
    columns = [
        (battle.health / scenario.unit_stats("health"))[:, None],
        battle.position,
        battle.cooldown[:, None],
        _one_hot_unit_types(scenario),
    ]
    units = jnp.where(alive(battle)[:, None], jnp.concatenate(columns, axis=1), 0)
    return jnp.concatenate([units.reshape(-1), scenario.is_enemy, scenario.unit_type.astype(np.float32)])
