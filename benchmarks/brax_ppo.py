"""PPO on Brax's halfcheetah with thousands of environments: ours, on true and on proxy rewards, beside Brax's own.

    python benchmarks/brax_ppo.py                                         on a GPU: 2,048 environments
    python benchmarks/brax_ppo.py --environments 32 --steps 200_000       smaller

Both programs have the same networks, learning rate, minibatches and epochs. Steps per second leave out the compilation
(`start`), and include one evaluation of ours in each third of the steps and Brax's after each third. Brax trains on true rewards only.
`lare-bayes` scores steps with the recorded function of HalfCheetah-v4, whose observation has the same entries.
"""

import functools
import itertools
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

import lare_rl
from lare_rl.algorithms.ppo import PPOSettings
from lare_rl.config.resolve import resolve
from lare_rl.runs.directory import create_run
from lare_rl.training.latent_functions import choose_functions
from lare_rl.training.session import start_session
from measure import advance, write

HIDDEN = (256, 256)
UNROLL, EPOCHS, N_MINIBATCHES = 20, 4, 32
LEARNING_RATE, ENTROPY, CLIP, GAMMA = 3e-4, 1e-3, 0.3, 0.97
BACKEND = "spring"


def make_task() -> lare_rl.TaskSpec:
    """Return HalfCheetah-v4 with Brax's simulator."""
    fields: dict[str, Any] = {"environment": "brax/halfcheetah", "arguments": {"backend": BACKEND}}
    return lare_rl.load_task("HalfCheetah-v4").model_copy(update=fields)


def train_ours(method: str, environments: int, steps: int, directory: Path) -> dict[str, Any]:
    """Train for three thirds of the steps, after one third that compiles, and evaluate after each."""
    task = make_task()
    third = steps // 3
    hyperparameters = PPOSettings(
        hidden=HIDDEN,
        learning_rate=LEARNING_RATE,
        gamma=GAMMA,
        epochs=EPOCHS,
        minibatch_size=environments // N_MINIBATCHES * UNROLL,
        clip=CLIP,
        entropy_coef=ENTROPY,
        max_grad_norm=1e9,
        normalise_observations=True,
    )
    settings = lare_rl.Settings(
        method=method,
        algorithm="ppo",
        ppo=hyperparameters,
        environments=environments,
        rollout_steps=UNROLL,
        seeds=1,
        steps=steps,
        evaluation_episodes=128,
        capacity=environments * 1100,
        evaluate_every=third,
    )
    resolved = resolve(settings, task)
    functions = choose_functions(task, resolved, None)
    session = start_session(create_run(directory, task, resolved, functions))
    start = time.perf_counter()
    advance(session, 2 * resolved.iteration_steps)
    start_s = time.perf_counter() - start
    returns, rates = [], []
    for until in (third, 2 * third, steps):
        start, before = time.perf_counter(), session.step
        advance(session, until - session.step)
        metrics = session.evaluate(0.0)
        rates.append((session.step - before) / (time.perf_counter() - start))
        returns.append(float(np.mean([record["evaluation/return"] for record in metrics])))
    session.close()
    return _describe(start_s, rates, returns)


def train_brax(environments: int, steps: int) -> dict[str, Any]:
    """Train with Brax's PPO on true rewards."""
    from brax import envs
    from brax.training.agents.ppo import networks
    from brax.training.agents.ppo.train import train

    if not hasattr(jax, "device_put_replicated"):  # which JAX has removed, and Brax 0.14 calls
        jax.device_put_replicated = lambda tree, devices: jax.tree.map(  # type: ignore[attr-defined]
            lambda leaf: jax.numpy.stack([leaf] * len(devices)), tree
        )
    times: list[tuple[float, int, float]] = []
    start = time.perf_counter()
    train(
        envs.get_environment("halfcheetah", backend=BACKEND),
        num_timesteps=steps,
        num_envs=environments,
        episode_length=1000,
        learning_rate=LEARNING_RATE,
        entropy_cost=ENTROPY,
        discounting=GAMMA,
        unroll_length=UNROLL,
        batch_size=environments // N_MINIBATCHES,
        num_minibatches=N_MINIBATCHES,
        num_updates_per_batch=EPOCHS,
        normalize_observations=True,
        clipping_epsilon=CLIP,
        network_factory=functools.partial(
            networks.make_ppo_networks, policy_hidden_layer_sizes=HIDDEN, value_hidden_layer_sizes=HIDDEN
        ),
        num_evals=5,
        num_eval_envs=128,
        deterministic_eval=True,
        progress_fn=lambda step, metrics: times.append(
            (time.perf_counter(), int(step), float(metrics["eval/episode_reward"]))
        ),
    )
    rates = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in itertools.pairwise(times[1:])]
    start_s = times[1][0] - start - (times[1][1] - times[0][1]) / rates[0]
    return _describe(start_s, rates, [score for *_, score in times[2:]])


def _describe(start_s: float, rates: list[float], returns: list[float]) -> dict[str, Any]:
    return {
        "steps/s": round(float(np.median(rates))),
        "steps/s, three parts": [round(rate) for rate in rates],
        "return after each part": [round(score) for score in returns],
        "start s": round(start_s, 1),
    }


def main(
    methods: tuple[str, ...] = ("dense", "bayes", "lare-bayes"),
    environments: int = 2048,
    steps: int = 8_000_000,
    out: str = "brax_ppo",
) -> None:
    """Measure.

    Args:
        methods: methods of ours.
        environments: environments in parallel.
        steps: steps of training, a quarter more for Brax, whose first part compiles.
        out: the name of the file of results.
    """
    steps = -(-steps // (3 * UNROLL * environments)) * 3 * UNROLL * environments
    results: dict[str, Any] = {"device": str(jax.devices()[0].device_kind)}
    results["brax"] = train_brax(environments, steps * 4 // 3)
    print("brax", results["brax"], flush=True)
    for method in methods:
        with tempfile.TemporaryDirectory() as folder:
            results[method] = train_ours(method, environments, steps, Path(folder) / "run")
        print(method, results[method], flush=True)
        write(out, results)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
