"""Learning curves of SBX's algorithms on the true rewards, for a comparison with ours.

    python benchmarks/sbx_learning.py OUT --algorithm sac      OUT/metrics.jsonl, as `lare-rl train --method dense` writes it

Hyperparameters and protocol are ours. Differences remain: SBX's targets move at every update, not at every second one. Its TD3's
actor ascends the smaller of the two critics, not the first. For its PPO, Stable-Baselines3's VecNormalize normalises observations
and rewards; ours normalises observations and the critic's targets. Seeds are trained one after the other; one core is enough
(`taskset -c 0 python ...`).
"""

import json
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import flax.linen as nn
import gymnasium
import jax
import numpy as np
import sbx
import tyro
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from evaluations import Evaluations, append_evaluation
from measure import PPO as PPO_COMMON
from measure import TD3, provenance

OFF_POLICY = {name: value for name, value in TD3.items() if name != "policy_delay"}
PPO = {**PPO_COMMON, "policy_kwargs": {"net_arch": [256, 256], "activation_fn": nn.tanh}}


def make_model(algorithm: str, environment: gymnasium.Env, warmup: int, seed: int) -> Any:
    """One of SBX's models, with our hyperparameters."""
    assert isinstance(environment.action_space, gymnasium.spaces.Box)
    actions = environment.action_space.shape
    noise = NormalActionNoise(np.zeros(actions), 0.1 * np.ones(actions))
    defaults = {"learning_starts": warmup, "seed": seed}
    match algorithm:
        case "td3":
            smooth = {"target_policy_noise": 0.2, "target_noise_clip": 0.5}
            return sbx.TD3("MlpPolicy", environment, action_noise=noise, **defaults, **smooth, **TD3)
        case "ddpg":
            return sbx.DDPG(
                "MlpPolicy", environment, action_noise=noise, qf_learning_rate=3e-4, **defaults, **OFF_POLICY
            )
        case "sac":
            return sbx.SAC("MlpPolicy", environment, **defaults, **OFF_POLICY)
        case _:
            return sbx.PPO("MlpPolicy", VecNormalize(DummyVecEnv([lambda: environment])), seed=seed, **PPO)


def main(
    out: Annotated[Path, tyro.conf.Positional],
    algorithm: Literal["td3", "ddpg", "sac", "ppo"] = "td3",
    task: str = "HalfCheetah-v4",
    steps: int = 100_000,
    seeds: int = 3,
    evaluate_every: int | None = None,
    episodes: int = 10,
    warmup: int = 10_000,
) -> None:
    """Train.

    Args:
        out: a new directory for the results.
        algorithm: the algorithm to train.
        task: Gymnasium id.
        steps: environment steps of each seed.
        seeds: number of seeds, from 0.
        evaluate_every: environment steps between two evaluations; the default is 5000, and 10,000 for ppo.
        episodes: episodes in one evaluation.
        warmup: random steps before the first update; ppo has none.
    """
    interval = evaluate_every or (10_000 if algorithm == "ppo" else 5000)
    turn = int(PPO["n_steps"]) if algorithm == "ppo" else 1
    if interval % turn or steps % interval:
        raise SystemExit(
            f"steps = {steps} must be a multiple of evaluate-every = {interval}, which must be a multiple of {turn}"
        )
    out.mkdir(parents=True)
    settings = {"steps": steps, "seeds": seeds}
    (out / "protocol.json").write_text(
        json.dumps({"algorithm": f"SBX {algorithm}", "task": task, "settings": settings, **provenance()}, indent=1)
        + "\n"
    )
    environment = gymnasium.make(task)
    for seed in range(seeds):
        model = make_model(algorithm, gymnasium.make(task), warmup, seed)
        report = partial(append_evaluation, out / "metrics.jsonl", model, environment, seed, episodes)
        model.learn(steps, log_interval=1_000_000, callback=Evaluations(interval, report))


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")
    tyro.cli(main, description=__doc__)
