"""The cost of a training step: one environment step of HalfCheetah-v4 and one update, compared with TD3 of other libraries.

    python benchmarks/training_step.py
    python benchmarks/training_step.py --warmup 50000      later in a run, where closed-form fits are rarer: the first table alone

LaRe's methods, TD3 of Stable-Baselines3 and TD3 of SBX take turns in one process. All have batches of 256, networks of 256-256, one
update for each step, an actor update for every second one, and a replay for a million transitions. `matrix products` are those of
one LaRe-RRDu update alone, in a compiled loop, on random numbers. A second table shows LaRe-RRDu by the length of its rollouts.
"""

import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import sbx
import stable_baselines3
import tyro
from jax import Array
from stable_baselines3.common.noise import NormalActionNoise

import lare_rl
from lare_rl.algorithms.td3 import TD3Settings
from lare_rl.training.session import Session
from measure import TD3, advance, interleave, new_session, ratio, show, summary, write

TASK, SEED = "HalfCheetah-v4", 0
WARMUP = 2000
"""Random steps before the first update, so that every method has whole episodes to draw."""
ROLLOUTS = (1, 10, 50, 200, 1000)


def open_session(directory: Path, method: str, warmup: int = WARMUP, rollout: int = 50) -> Session:
    settings = lare_rl.Settings(
        method=method, seed=SEED, rollout_steps=rollout, evaluation_episodes=1, td3=TD3Settings(warmup=warmup)
    )
    session = new_session(directory / f"{method}-{rollout}", TASK, settings)
    advance(session, warmup)
    return session


def make_model(algorithm: Callable[..., Any], warmup: int) -> Any:
    model = algorithm(
        "MlpPolicy",
        TASK,
        learning_starts=warmup,
        action_noise=NormalActionNoise(np.zeros(6), 0.1 * np.ones(6)),
        seed=SEED,
        **TD3,
        device="cpu",
    )
    return model.learn(warmup, log_interval=1_000_000)


def go_on(model: Any, steps: int) -> None:
    model.learn(steps, reset_num_timesteps=False, log_interval=1_000_000)


Weights = list[Array]


def forward(weights: Weights, x: Array) -> tuple[list[Array], Array]:
    """One product for each layer; returns each layer's input, and the output."""
    inputs = []
    for weight in weights:
        inputs.append(x)
        x = x @ weight
    return inputs, x


def backward(
    weights: Weights, inputs: list[Array], gradient: Array, *, to_weights: bool = True, to_input: bool = False
) -> Weights:
    """Two products for each layer; the one to the first layer's input only if `to_input`."""
    gradients = []
    for layer in reversed(range(len(weights))):
        if to_weights:
            gradients.append(inputs[layer].T @ gradient)
        if layer or to_input:
            gradient = gradient @ weights[layer].T
    return [*gradients, gradient] if to_input else gradients


def matrix_products(factors: int, observation: int, action: int, updates: int = 50) -> Callable[[], object]:
    """A compiled loop over the matrix products of `updates` LaRe-RRDu updates.

    decoder: forward and backward on 256 drawn steps, forward on the 256 of the batch (relabelling)
    target actor, both target critics: forward;  both critics: forward and backward
    every second update: actor and first critic forward, back through the critic to its input, back through the actor

    Every product's result is returned, or used by another product, so that the compiler cannot leave one out.
    """
    draw = np.random.default_rng(SEED)

    def network(inputs: int, outputs: int) -> Weights:
        sizes = (inputs, 256, 256, outputs)
        return [jnp.asarray(draw.normal(0, m**-0.5, (m, n)), jnp.float32) for m, n in pairwise(sizes)]

    def rows(width: int) -> Array:
        return jnp.asarray(draw.normal(size=(updates, 256, width)), jnp.float32)

    pair = observation + action
    networks = {
        "decoder": network(factors, 1),
        "actor": network(observation, action),
        "target actor": network(observation, action),
        "critics": [network(pair, 1), network(pair, 1)],
        "target critics": [network(pair, 1), network(pair, 1)],
    }
    inputs = {
        "number": jnp.arange(updates),
        "drawn": rows(factors),
        "batch": rows(factors),
        "pair": rows(pair),
        "observation": rows(observation),
        "next": rows(observation),
        "next pair": rows(pair),
        "policy pair": rows(pair),
    }

    def actor_update(networks: dict[str, Any], turn: dict[str, Array]) -> list[Array]:
        inputs, action = forward(networks["actor"], turn["observation"])
        critic = networks["critics"][0]
        through, value = forward(critic, turn["policy pair"])
        (to_pair,) = backward(critic, through, value, to_weights=False, to_input=True)
        return [action, *backward(networks["actor"], inputs, to_pair[:, observation:])]

    def update(networks: dict[str, Any], before: Any, turn: dict[str, Array]) -> Any:
        inputs, r_hat = forward(networks["decoder"], turn["drawn"])
        gradients = backward(networks["decoder"], inputs, r_hat)
        gradients.append(forward(networks["decoder"], turn["batch"])[1])
        gradients.append(forward(networks["target actor"], turn["next"])[1])
        gradients += [forward(critic, turn["next pair"])[1] for critic in networks["target critics"]]
        for critic in networks["critics"]:
            inputs, value = forward(critic, turn["pair"])
            gradients += backward(critic, inputs, value)
        delayed = jax.lax.cond(turn["number"] % 2 == 1, lambda: actor_update(networks, turn), lambda: before["delayed"])
        return {"found": gradients, "delayed": delayed}

    @jax.jit
    def loop(networks: dict[str, Any], inputs: dict[str, Array]) -> Any:
        first = jax.tree.map(lambda x: x[0], inputs)
        delayed = jax.tree.map(jnp.zeros_like, jax.eval_shape(actor_update, networks, first))
        shapes = jax.eval_shape(update, networks, {"delayed": delayed}, first)
        start = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        return jax.lax.scan(lambda before, turn: (update(networks, before, turn), None), start, inputs)[0]

    return lambda: jax.block_until_ready(loop(networks, inputs))


def repeat(work: Callable[[], object], times: int) -> None:
    for _ in range(times):
        work()


def side_by_side(directory: Path, steps: int, warmup: int) -> Iterator[tuple[str, Callable[[], object]]]:
    for method in ("lare-bayes", "lare-rrdu", "rrdu", "dense"):
        session = open_session(directory, method, warmup)
        yield method, partial(advance, session, steps)
        if method == "lare-rrdu":
            env, (factors,) = session.config.env, session.config.n_factors
            products = matrix_products(factors, env.observation_size, env.action_size)
            yield "matrix products", partial(repeat, products, steps // 50)
    yield "Stable-Baselines3 TD3", partial(go_on, make_model(stable_baselines3.TD3, warmup), steps)
    yield "SBX TD3", partial(go_on, make_model(sbx.TD3, warmup), steps)


def main(rounds: int = 7, steps: int = 1000, warmup: int = WARMUP) -> None:
    """Measure.

    Args:
        rounds: number of turns of each contender.
        steps: environment steps in a turn, a multiple of 50.
        warmup: random steps before the first update.
    """
    figures = {
        "task": TASK,
        "seeds": [SEED],
        "rounds": rounds,
        "steps in a round": steps,
        "random steps before": warmup,
    }
    with tempfile.TemporaryDirectory() as folder:
        seconds = interleave(dict(side_by_side(Path(folder), steps, warmup)), rounds)
        table = summary(seconds, steps, "SBX TD3")
        show("training step", table, "SBX TD3")
        if warmup != WARMUP:
            write(f"training_step_after_{warmup}", {**figures, "training step": table})
            return
        rollouts = [rollout for rollout in ROLLOUTS if rollout <= steps]
        sessions = {
            rollout: open_session(Path(folder) / "rollouts", "lare-rrdu", rollout=rollout) for rollout in rollouts
        }
        rollout_seconds = interleave(
            {str(rollout): partial(advance, session, steps) for rollout, session in sessions.items()}, rounds
        )
    by_rollout = summary(rollout_seconds, steps, "50")
    share = ratio(seconds["matrix products"], seconds["lare-rrdu"])
    print(f"the matrix products alone: {share:.1%} of lare-rrdu")
    show("lare-rrdu, by rollout_steps", by_rollout, "50 steps")
    share_row = {"matrix products, share of lare-rrdu": share}
    write("training_step", {**figures, "training step": table, **share_row, "by rollout_steps": by_rollout})


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")
    tyro.cli(main, description=__doc__)
