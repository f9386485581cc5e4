"""Whether our battles agree with SMAX in JaxMARL: both are played with the same choices and the same random numbers, and compared.

    pip install jaxmarl==0.2.0        # installs flax and others, so use a separate environment
    python benchmarks/smax_oracle.py

Whole battles are played. Our game makes each step from JaxMARL's state. A second game of ours begins in JaxMARL's initial state and
is never corrected; it shows how rounding errors grow when units push each other. Our side mixes JaxMARL's heuristic, retreats and
random legal choices. The enemy is JaxMARL's, and its choices are used in both games. An enemy's choice is left out of the
comparison only if the unit walks while it sees several of our units, because its target is then a separate random draw. JaxMARL's
`max_steps` is one less than the limit, because JaxMARL compares before it counts. Steps of one battle of each task can be saved for
the tests (`--pin tests/tasks/smax/pinned.npz`).
"""

import sys
from collections import defaultdict
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from lare_rl.envs.smax import battle, enemy
from lare_rl.envs.smax.scenarios import SCENARIOS, UNIT_TYPES, Scenario, find_scenario
from lare_rl.envs.smax.smax_env import WIN_RETURN, global_state, observe, reward
from measure import write

streams = sys.stdout, sys.stderr
from jaxmarl.environments.smax.heuristic_enemy import create_heuristic_policy  # noqa: E402
from jaxmarl.environments.smax.heuristic_enemy_smax_env import HeuristicEnemySMAX  # noqa: E402
from jaxmarl.environments.smax.smax_env import Scenario as JaxmarlScenario  # noqa: E402

sys.stdout, sys.stderr = streams  # the import has replaced them


class Style(NamedTuple):
    """How our side plays."""

    random: float = 0.0
    """The share of choices that are random legal ones; the others are those of JaxMARL's heuristic."""
    kites: bool = False
    """Whether a unit walks away from the enemy while its weapon is not ready."""
    waits: bool = False
    """Whether no unit does anything, on either side, until the time limit."""


STYLES = (Style(0.1), Style(0.4), Style(1.0), Style(), Style(0.05, kites=True), Style(kites=True))
OUTPUTS = "observation", "state", "reward", "ends", "legal actions"
PINNED = {"2s3z": "won", "3s_vs_5z": "lost", "1c3s5z": "lost"}
"""For each task, the longest battle with this end is saved for the tests."""


def make_jaxmarl_env(scenario: Scenario) -> HeuristicEnemySMAX:
    """JaxMARL's environment, with the colossus appended to its unit types if the battle has one."""
    table = list(UNIT_TYPES.values())[: scenario.n_unit_types]
    figures = {
        "unit_type_velocities": [kind.speed for kind in table],
        "unit_type_attacks": [kind.damage for kind in table],
        "unit_type_attack_ranges": [kind.attack_range for kind in table],
        "unit_type_sight_ranges": [kind.sight for kind in table],
        "unit_type_radiuses": [kind.radius for kind in table],
        "unit_type_health": [kind.health for kind in table],
        "unit_type_weapon_cooldowns": [kind.cooldown for kind in table],
    }
    # Its own unit types keep their own figures, so that our figures are compared, too.
    arguments: dict[str, Any] = {}
    if scenario.n_unit_types > 6:
        defaults = HeuristicEnemySMAX()._env
        arguments = {
            name: jnp.concatenate([getattr(defaults, name), jnp.array(values[6:], jnp.float32)])
            for name, values in figures.items()
        }
        arguments["unit_type_names"] = [*defaults.unit_type_names, *list(UNIT_TYPES)[6 : scenario.n_unit_types]]
        arguments["unit_type_shorthands"] = [*defaults.unit_type_shorthands, "c"]
    kinds = jnp.asarray(scenario.unit_type, jnp.uint8)
    jaxmarl_scenario = JaxmarlScenario(kinds, scenario.n_allies, scenario.n_enemies, False, False)
    return HeuristicEnemySMAX(
        scenario=jaxmarl_scenario, attack_mode="closest", max_steps=scenario.max_steps - 1, **arguments
    )


@dataclass
class Worst:
    """For each name: the largest deviation, or how many values differ, and how many were compared."""

    deviation: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    differing: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    compared: dict[str, int] = field(default_factory=lambda: defaultdict(int))

    def close(self, name: str, value: Any, other: Any) -> None:
        value, other = np.asarray(value, np.float64), np.asarray(other, np.float64)
        assert value.shape == other.shape, name
        self.compared[name] += value.size
        self.deviation[name] = max(self.deviation[name], float(np.abs(value - other).max(initial=0)))

    def same(self, name: str, value: Any, other: Any) -> None:
        value, other = np.asarray(value), np.asarray(other)
        assert value.shape == other.shape, name
        self.compared[name] += value.size
        self.differing[name] += int((value != other).sum())

    def off(self, name: str) -> str:
        """The largest deviation, or how many values differ."""
        return format(self.deviation[name], ".1e") if name in self.deviation else str(self.differing.get(name, ""))


def draw_cooldowns(key: jax.Array, units: int) -> jax.Array:
    """The random numbers that JaxMARL's `step_env` adds to the cooldowns, with the same keys."""
    key, _ = jax.random.split(key)
    rows = []
    for _ in range(battle.TICKS):
        key, tick = jax.random.split(key)
        draw = partial(jax.random.uniform, minval=-battle.TICK, maxval=2 * battle.TICK)
        rows.append(jax.vmap(draw)(jax.random.split(tick, units)))
    return jnp.stack(rows)


class Match:
    """Both games, compiled."""

    def __init__(self, name: str):
        self.scenario = find_scenario(name)
        self.jaxmarl = make_jaxmarl_env(self.scenario)
        self.env = self.jaxmarl._env
        self.policy = create_heuristic_policy(self.env, 0, attack_mode="closest")
        self.choose, self.their_step, self.our_step = map(jax.jit, (self._choose, self._their_step, self._our_step))
        self.draw_cooldowns = jax.jit(partial(draw_cooldowns, units=self.scenario.n_units))

    def rows(self, values: dict, side: str) -> jax.Array:
        count = self.scenario.n_allies if side == "ally" else self.scenario.n_enemies
        return jnp.stack([values[f"{side}_{i}"] for i in range(count)])

    def _choose(self, key, state, memories, style):
        """The actions of both sides; the enemy always follows JaxMARL's heuristic."""
        allies = self.scenario.n_allies
        seen = self.env.get_obs(state)
        keys = jax.random.split(key, 4)
        ally_action, first = jax.vmap(self.policy)(
            jax.random.split(keys[0], allies), memories[0], self.rows(seen, "ally")
        )
        legal = self.rows(self.env.get_avail_actions(state), "ally")
        ally_action = jnp.where(
            style.kites & (state.unit_weapon_cooldowns[:allies] > 0), self._retreat(state), ally_action
        )
        chance = jnp.argmax(jnp.where(legal, jax.random.uniform(keys[1], legal.shape), -1), axis=1)
        ally_action = jnp.where(jax.random.uniform(keys[2], ally_action.shape) < style.random, chance, ally_action)
        ally_action = jnp.where(
            state.unit_alive[:allies], ally_action, battle.STOP
        )  # its heuristic chooses for the dead too
        enemies, second = self.jaxmarl.get_enemy_actions(keys[3], memories[1], self.rows(seen, "enemy"))
        action = jnp.concatenate([ally_action, self.rows(enemies, "enemy")])
        return jnp.where(style.waits, battle.STOP, action).astype(jnp.int32), (first, second)

    def _retreat(self, state):
        """The directions away from the enemies, mostly from near ones, and from the border."""
        allies, position = self.scenario.n_allies, state.unit_positions
        offset = position[:allies, None] - position[allies:]
        nearness = state.unit_alive[allies:, None] / (jnp.sum(offset**2, axis=-1, keepdims=True) + 1)
        inwards = (battle.FIELD / 2 - position[:allies]) / battle.FIELD
        return jnp.argmax((jnp.sum(nearness * offset, axis=1) + inwards) @ battle.DIRECTIONS.T, axis=1)

    def _their_step(self, key, state, action):
        seen, state, rewards, over, _ = self.env.step_env(key, state, dict(zip(self.env.agents, action, strict=True)))
        legal = self.rows(self.env.get_avail_actions(state), "ally")
        return (
            state,
            self.rows(seen, "ally"),
            seen["world_state"],
            WIN_RETURN / 2 * rewards["ally_0"],
            over["__all__"],
            legal,
        )

    def _our_step(self, key, state, memory, action, longer):
        scenario = self.scenario
        choice, memory = enemy.choose_actions(scenario, state, memory, key)
        sight = jnp.asarray(scenario.unit_stats("sight"))[:, None]
        near = (battle.distances(state.position) < sight) & battle.alive(state)
        sees = jnp.sum(near[scenario.n_allies :, : scenario.n_allies], axis=1)
        after = battle.advance(scenario, state, action, longer)
        lost, won = battle.defeated(scenario, after)
        over = lost | won | (after.step >= scenario.max_steps)
        seen, field = observe(scenario, after), global_state(scenario, after)
        outputs = seen, field, reward(scenario, state, after), over, battle.available_actions(scenario, after)
        return after, memory, choice, sees, outputs

    def begin(self, key: jax.Array, worst: Worst):
        """JaxMARL's initial state, and our state from the same draws."""
        scenario = self.scenario
        _, state = self.env.reset(key)
        _, *keys = jax.random.split(key, 3)
        sides = zip(keys, (scenario.n_allies, scenario.n_enemies), strict=True)
        noise = [jax.random.uniform(side_key, (count, 2), minval=-2, maxval=2) for side_key, count in sides]
        middle = np.repeat(
            np.array([battle.ALLY_START, battle.ENEMY_START]), [scenario.n_allies, scenario.n_enemies], axis=0
        )
        placed = battle.separate_units(scenario, jnp.concatenate(noise) + middle, jnp.ones(scenario.n_units, bool))
        worst.close("position at the start", placed, state.unit_positions)
        battle_state = battle.start_battle(scenario, key)._replace(position=state.unit_positions)
        worst.same("health", battle_state.health, state.unit_health)
        return state, battle_state

    def play(self, seed: int, style: Style, worst: Worst, alone: Worst) -> tuple[str, dict[str, np.ndarray]]:
        """Play one battle to its end; returns how it ended, and all of JaxMARL's data."""
        scenario, allies = self.scenario, self.scenario.n_allies
        start, key = jax.random.split(jax.random.key(seed))
        state, battle_state = self.begin(start, worst)
        memory = enemy.init_memory(scenario, battle_state)
        memory_row = jax.tree.map(lambda leaf: leaf[0], self.jaxmarl.get_enemy_policy_initial_state(start))
        memories = tuple(
            jax.tree.map(lambda leaf, count=count: jnp.stack([leaf] * count), memory_row)
            for count in (allies, scenario.n_enemies)
        )
        records: dict[str, list] = defaultdict(list)
        free, over = battle_state, False
        while not over:
            key, choice_key, step_key = jax.random.split(key, 3)
            action, memories = self.choose(choice_key, state, memories, style)
            lived, longer = np.asarray(state.unit_alive), self.draw_cooldowns(step_key)
            battle_state = battle_state._replace(
                position=state.unit_positions, health=state.unit_health, cooldown=state.unit_weapon_cooldowns
            )
            for name in ("position", "health", "cooldown"):
                records[f"before/{name}"].append(getattr(battle_state, name))
            state, *their_outputs = self.their_step(step_key, state, action)
            free, *_, free_outputs = self.our_step(choice_key, free, memory, action, longer)
            battle_state, memory, choice, sees, our_outputs = self.our_step(
                choice_key, battle_state, memory, action, longer
            )

            enemy_action = np.asarray(action)[allies:]
            attacks = (enemy_action >= battle.ATTACK) | (np.asarray(choice) >= battle.ATTACK)
            decided = lived[allies:] & (attacks | (np.asarray(sees) <= 1))
            if not style.waits:
                worst.same("the enemy's choices", np.asarray(choice)[decided], enemy_action[decided])
                worst.compared["walks towards one of several, left out"] += int((lived[allies:] & ~decided).sum())
            for deviations, after, outputs in ((worst, battle_state, our_outputs), (alone, free, free_outputs)):
                deviations.same("health", after.health, state.unit_health)
                deviations.same("who lives", battle.alive(after), state.unit_alive)
                deviations.same("who may attack", after.cooldown <= 0, state.unit_weapon_cooldowns <= 0)
                deviations.close("cooldown", after.cooldown, state.unit_weapon_cooldowns)
                deviations.close("position", after.position, state.unit_positions)
                for name, value, expected in zip(OUTPUTS, outputs, their_outputs, strict=True):
                    (deviations.same if name in ("ends", "legal actions") else deviations.close)(name, value, expected)
            for name, their in zip(OUTPUTS, their_outputs, strict=True):
                records[name].append(their)
            over = bool(their_outputs[3])
            records["action"].append(action)
            records["longer"].append(used(scenario, longer, state.unit_weapon_cooldowns))
            records["health"].append(state.unit_health)
            records["cooldown"].append(state.unit_weapon_cooldowns)
            records["position"].append(state.unit_positions)
        allies_dead, enemies_dead = map(bool, battle.defeated(scenario, battle_state))
        end = "won" if enemies_dead and not allies_dead else "lost" if allies_dead else "time"
        return end, {name: np.stack([np.asarray(row) for row in rows]) for name, rows in records.items()}


def used(scenario: Scenario, longer: jax.Array, cooldown: jax.Array) -> np.ndarray:
    """The random draw that each unit's attack used, among those of a step's ticks; 0 without an attack. No unit attacks twice in a
    step.
    """
    remaining = battle.TICK * (battle.TICKS - 1 - np.arange(battle.TICKS))[:, None]
    off = np.abs(scenario.unit_stats("cooldown") + np.asarray(longer) - remaining - np.asarray(cooldown))
    chosen = np.take_along_axis(np.asarray(longer), off.argmin(0)[None], axis=0)[0]
    return np.where(off.min(0) < 1e-5, chosen, 0).astype(np.float32)


def pinned(records: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The data of a battle that the tests need: some of its steps, each with inputs and outputs."""
    last = len(records["action"]) - 1
    steps = np.unique(np.linspace(0, last, 16).astype(int))
    few = np.isin(steps, steps[[3, 8, -1]])
    narrow = {"action": np.uint8, "legal actions": bool, "reward": np.float32}
    rows = {name: row[steps].astype(narrow.get(name, row.dtype)) for name, row in records.items()}
    rows |= {name: rows[name][few] for name in ("observation", "state")}
    return {"step": steps, "few": few} | {name.replace(" ", "_"): row for name, row in rows.items()}


def main(battles: int = 12, tasks: tuple[str, ...] = tuple(SCENARIOS), pin: Path | None = None) -> None:
    """Play and compare.

    Args:
        battles: number of battles of each task; there is one more, in which all units stand and wait.
        tasks: the tasks to compare.
        pin: a file in which to save a battle of each task for the tests.
    """
    figures, keep = {}, {}
    for name in tasks:
        match, worst, alone, ends, steps = Match(name), Worst(), Worst(), defaultdict(int), 0
        for seed in range(battles + 1):
            style = STYLES[seed % len(STYLES)] if seed < battles else Style(waits=True)
            end, records = match.play(seed, style, worst, alone)
            ends[end] += 1
            steps += len(records["action"])
            if end == PINNED[name] and len(records["action"]) > len(keep.get(name, {"action": ()})["action"]):
                keep[name] = records
        figures[name] = {"battles": dict(ends), "steps": steps, **vars(worst), "never set right": vars(alone)}
        print(f"\n{name}: {steps} steps, {dict(ends)}")
        print(f"{'compared':42s} {'numbers':>9s} {'off by':>9s}   never set right")
        for what, count in worst.compared.items():
            print(f"{what:42s} {count:9d} {worst.off(what):>9s} {alone.off(what):>9s}")
    if pin:
        flat = {f"{name}/{key}": row for name, records in keep.items() for key, row in pinned(records).items()}
        np.savez_compressed(pin, allow_pickle=False, **flat)
    write(
        "smax_oracle",
        {"styles": [style._asdict() for style in STYLES], "jaxmarl": version("jaxmarl"), "tasks": figures},
    )


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
