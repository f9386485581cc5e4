"""The cost of a step of a battle, by battle and by the number of battles at once.

    taskset -c 0 python benchmarks/smax.py

The first 60 steps of each battle, with random legal choices; observations and states are read. A whole batch is one compiled call.
"""

import time
from functools import partial

import jax
import jax.numpy as jnp
import tyro
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.envs.smax.scenarios import SCENARIOS
from lare_rl.envs.smax.smax_env import SMAX
from measure import interleave, show, summary, write

STEPS = 60
"""Steps of each battle in one call."""


@partial(jax.jit, static_argnums=(0, 2))
def battles(env: SMAX, key: PRNGKeyArray, worlds: int) -> Float[Array, "worlds steps"]:
    """Play a batch of battles. The sums keep the compiler from leaving anything out."""

    def step(carry, key: PRNGKeyArray):
        state, timestep = carry
        choice_key, key = jax.random.split(key)
        chance = jax.random.uniform(choice_key, timestep.available.shape)
        choice = jnp.argmax(jnp.where(timestep.available, chance, -1), axis=1)
        state, timestep = env.step(state, jax.nn.one_hot(choice, env.spec.action_size), key)
        return (state, timestep), jnp.sum(timestep.observation) + jnp.sum(timestep.state) + jnp.sum(timestep.reward)

    def run(key: PRNGKeyArray) -> Float[Array, " steps"]:
        start_key, key = jax.random.split(key)
        return jax.lax.scan(step, env.reset(start_key), jax.random.split(key, STEPS))[1]

    return jax.vmap(run)(jax.random.split(key, worlds))


def main(rounds: int = 7, batches: tuple[int, ...] = (1, 32, 256), calls: int = 1024) -> None:
    """Measure.

    Args:
        rounds: number of turns of each contender.
        batches: numbers of battles in one call.
        calls: about how many battles in a turn.
    """
    figures, compiling = {}, {}
    for name in SCENARIOS:
        env = SMAX(name)

        def turn(worlds: int, env: SMAX = env) -> None:
            for number in range(max(1, calls // worlds)):
                jax.block_until_ready(battles(env, jax.random.key(number), worlds))

        for worlds in batches:
            start = time.process_time()
            battles.lower(env, jax.random.key(0), worlds).compile()
            compiling[f"{name}, {worlds}"] = time.process_time() - start
        contenders = {str(worlds): partial(turn, worlds) for worlds in batches}
        seconds = interleave(contenders, rounds)
        seconds_by_batch = {
            who: [value / (STEPS * int(who) * max(1, calls // int(who))) for value in values]
            for who, values in seconds.items()
        }
        figures[name] = summary(seconds_by_batch, 1, str(batches[0]))
        for row in figures[name].values():
            row["steps a second"] = round(1000 / row["median ms"])
        show(f"{name}, a step of a battle", figures[name], str(batches[0]))
        print({who: row["steps a second"] for who, row in figures[name].items()}, "steps a second")
    print("compiling, in seconds of a processor:", {what: round(value, 1) for what, value in compiling.items()})
    write(
        "smax", {"rounds": rounds, "steps of a battle": STEPS, "compiling s": compiling, "step of one battle": figures}
    )


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
