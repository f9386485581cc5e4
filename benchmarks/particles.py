"""The cost of a step of cooperative navigation, compared with mpe2's `simple_spread`. The contenders take turns.

    python benchmarks/particles.py

Random actions, episodes of 25 steps, all observations and rewards computed. Our environment steps whole batches of worlds in one
compiled call. mpe2, the maintained package of the multi-agent particle environments, steps one world with the same numbers of
agents and landmarks. Its task differs slightly from ours (see `docs/reference/particle-tasks.md`), but the work is the same.
"""

import warnings
from functools import partial

import jax
import jax.numpy as jnp
import tyro
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.envs.particles.catalogue import find_particle_task
from lare_rl.envs.particles.task import MAX_STEPS, N_ACTIONS, ParticleTask
from lare_rl.envs.particles.world import State
from measure import interleave, show, summary, write

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)
    from mpe2 import simple_spread_v3


@partial(jax.jit, static_argnums=(0, 2))
def episodes(task: ParticleTask, key: PRNGKeyArray, worlds: int) -> Float[Array, "worlds steps"]:
    """One episode in each world. The sums keep the compiler from leaving anything out."""

    def step(state: State, key: PRNGKeyArray):
        action_key, key = jax.random.split(key)
        state = task.step(state, jax.random.randint(action_key, (task.n_agents,), 0, N_ACTIONS), key)
        return state, jnp.sum(task.observe(state)) + jnp.sum(task.reward(state))

    def run(key: PRNGKeyArray) -> Float[Array, " steps"]:
        start_key, key = jax.random.split(key)
        return jax.lax.scan(step, task.reset(start_key), jax.random.split(key, MAX_STEPS))[1]

    return jax.vmap(run)(jax.random.split(key, worlds))


def step_particles(task: ParticleTask, worlds: int) -> None:
    jax.block_until_ready(episodes(task, jax.random.key(0), worlds))


def step_mpe2(environment) -> None:
    environment.reset(seed=0)
    while environment.agents:
        environment.step({agent: environment.action_space(agent).sample() for agent in environment.agents})


def main(rounds: int = 7, batches: tuple[int, ...] = (64, 1024)) -> None:
    """Measure.

    Args:
        rounds: number of turns of each contender.
        batches: numbers of our worlds in one call.
    """
    figures = {}
    for name in ("CN-6", "CN-30"):
        task = find_particle_task(name)
        contenders = {f"{worlds} worlds": partial(step_particles, task, worlds) for worlds in batches}
        contenders["mpe2"] = partial(step_mpe2, simple_spread_v3.parallel_env(N=task.n_agents, max_cycles=MAX_STEPS))
        steps = {**{f"{worlds} worlds": worlds * MAX_STEPS for worlds in batches}, "mpe2": MAX_STEPS}
        seconds = interleave(contenders, rounds)
        ms_per_step = {who: [value / steps[who] for value in values] for who, values in seconds.items()}
        figures[name] = summary(ms_per_step, 1, f"{batches[0]} worlds")
        show(f"{name}, a step of a world", figures[name], f"{batches[0]} worlds")
    write("particles", {"rounds": rounds, "steps in an episode": MAX_STEPS, "step of one world": figures})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
