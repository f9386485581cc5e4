"""Learning curve of SBX's TD3 on the true rewards, to be laid over ours.

    python benchmarks/sbx_td3.py OUT            OUT/metrics.jsonl, as `lare train --method dense` writes it

Hyperparameters and protocol are ours. SBX itself differs from the paper, and from us, in that its targets follow at every
update, not every second one, and its actor ascends the smaller of the two critics, not the first. Seeds are trained one
after the other; one core does (`taskset -c 0 python ...`).
"""

import json
from pathlib import Path
from typing import Annotated

import gymnasium
import jax
import numpy as np
import sbx
import tyro
from measure import TD3, provenance
from stable_baselines3.common.noise import NormalActionNoise


def evaluate(model: sbx.TD3, environment: gymnasium.Env, seed: int, episodes: int) -> float:
    """Mean return of the deterministic policy, from the same starts at every evaluation."""
    returns = np.zeros(episodes)
    for episode in range(episodes):
        observation, _ = environment.reset(seed=1_000_000 + 1000 * seed + episode)
        ended = False
        while not ended:
            action, _ = model.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, _ = environment.step(action)
            returns[episode] += float(reward)
            ended = terminated or truncated
    return float(returns.mean())


def main(
    out: Annotated[Path, tyro.conf.Positional],
    steps: int = 100_000,
    seeds: int = 3,
    task: str = "HalfCheetah-v4",
    evaluate_every: int = 5000,
    episodes: int = 10,
    warmup: int = 10_000,
) -> None:
    """Train.

    Args:
        out: a new directory for the results.
        steps: environment steps of each seed.
        seeds: how many seeds, from 0.
        task: Gymnasium id.
        evaluate_every: environment steps between two evaluations.
        episodes: episodes in one evaluation.
        warmup: random steps before the first update.
    """
    out.mkdir(parents=True)
    (out / "config.json").write_text(
        json.dumps(
            {"algorithm": "SBX TD3", "task": task, "settings": {"steps": steps, "seeds": seeds}, **provenance()},
            indent=1,
        )
        + "\n"
    )
    environment = gymnasium.make(task)
    assert isinstance(environment.action_space, gymnasium.spaces.Box)
    actions = environment.action_space.shape
    for seed in range(seeds):
        model = sbx.TD3(
            "MlpPolicy",
            gymnasium.make(task),
            learning_starts=warmup,
            target_policy_noise=0.2,
            target_noise_clip=0.5,
            action_noise=NormalActionNoise(np.zeros(actions), 0.1 * np.ones(actions)),
            seed=seed,
            **TD3,
        )
        for step in range(evaluate_every, steps + 1, evaluate_every):
            model.learn(evaluate_every, reset_num_timesteps=False, log_interval=1_000_000)
            assert model.num_timesteps == step
            line = {"step": step, "seed": seed, "evaluation/return": evaluate(model, environment, seed, episodes)}
            with (out / "metrics.jsonl").open("a") as file:
                file.write(json.dumps(line) + "\n")
            print(f"seed {seed}  step {step:>7d}  return {line['evaluation/return']:10.1f}", flush=True)


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")
    tyro.cli(main, description=__doc__)
