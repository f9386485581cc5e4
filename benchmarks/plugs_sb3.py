"""The cost of `lare_rl.integrations.sb3` in Stable-Baselines3, and learning curves with it.

    python benchmarks/plugs_sb3.py cost                                      results/plugs/sb3_cost.json
    python benchmarks/plugs_sb3.py learn --algorithm td3 --rewards lare-bayes   results/plugs/td3-lare-bayes.jsonl

`cost`: processor time of a whole step of TD3 on HalfCheetah-v4 with networks of 256-256, with and without the plug, by turns within
one process. A turn is one episode, so that a closed-form decoder is fitted in it. One core is enough.

`learn`: true returns of the deterministic policy. `episodic` and `dense` are Stable-Baselines3 alone; every other name is a method
with the plug, which sees the returns of whole episodes only. The hyperparameters of TD3 are the paper's; those of PPO and of SBX's
SAC are those of `sbx_learning.py`.
"""

import json
import time
from functools import partial
from pathlib import Path
from typing import Any, Literal

import gymnasium
import jax
import numpy as np
import torch
import tyro
from stable_baselines3 import PPO, TD3
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import lare_rl
from evaluations import Evaluations, append_evaluation
from lare_rl.integrations.sb3 import CreditCallback, CreditReplayBuffer
from measure import PPO as PPO_COMMON
from measure import TD3 as TD3_SETTINGS
from measure import interleave, provenance, show, summary, write

TASK, RESULTS = "HalfCheetah-v4", Path(__file__).parent / "results" / "plugs"
PPO_SETTINGS: dict[str, Any] = {**PPO_COMMON, "policy_kwargs": {"net_arch": [256, 256], "activation_fn": torch.nn.Tanh}}


def assigner(method: str, task: lare_rl.TaskSpec, seed: int, **more: Any) -> lare_rl.CreditAssigner:
    """An assigner, with the function of the recorded replies if the method needs one."""
    phi = lare_rl.design(task) if method.startswith("lare-") else None
    return lare_rl.CreditAssigner(method, phi, task=task, seed=seed, **more)


def make_environment(task: lare_rl.TaskSpec, dense: bool) -> gymnasium.Env:
    """The environment with a true reward at every step, or with the return at the end."""
    environment = gymnasium.make(task.environment)
    return environment if dense else lare_rl.EpisodicReward(environment)


def plug_arguments(task: lare_rl.TaskSpec, rewards: str, seed: int) -> dict[str, Any]:
    """The plug's arguments for an algorithm with a replay buffer; empty if it learns from its environment's rewards."""
    if rewards in ("dense", "episodic"):
        return {}
    credit = assigner(rewards, task, seed, capacity=TD3_SETTINGS["buffer_size"])
    return {"replay_buffer_class": CreditReplayBuffer, "replay_buffer_kwargs": {"credit": credit}}


def td3(task: lare_rl.TaskSpec, rewards: str, seed: int, warmup: int) -> TD3:
    """TD3 on the true rewards (`dense`), on the return (`episodic`), or on those of a method."""
    environment, plug = make_environment(task, rewards == "dense"), plug_arguments(task, rewards, seed)
    noise = NormalActionNoise(np.zeros(task.action_size), 0.1 * np.ones(task.action_size))
    settings: Any = TD3_SETTINGS | {"policy_kwargs": dict(TD3_SETTINGS["policy_kwargs"])}  # SB3 writes into it
    return TD3(
        "MlpPolicy",
        environment,
        action_noise=noise,
        learning_starts=warmup,
        seed=seed,
        device="cpu",
        **settings,
        **plug,
    )


def sbx_sac(task: lare_rl.TaskSpec, rewards: str, seed: int, warmup: int) -> Any:
    """SBX's SAC, likewise. SBX is imported here, because the others do not need it."""
    from sbx import SAC

    from sbx_learning import OFF_POLICY

    settings = {"learning_starts": warmup, "seed": seed, **OFF_POLICY, **plug_arguments(task, rewards, seed)}
    return SAC("MlpPolicy", make_environment(task, rewards == "dense"), **settings)


def ppo(task: lare_rl.TaskSpec, rewards: str, seed: int) -> tuple[PPO, list[CreditCallback]]:
    """PPO, normalised by VecNormalize, and the callback with which it learns from a method."""
    environment = VecNormalize(DummyVecEnv([partial(make_environment, task, rewards == "dense")]))
    settings: Any = PPO_SETTINGS | {"policy_kwargs": dict(PPO_SETTINGS["policy_kwargs"])}
    model = PPO("MlpPolicy", environment, seed=seed, device="cpu", **settings)
    if rewards in ("dense", "episodic"):
        return model, []
    return model, [CreditCallback(assigner(rewards, task, seed, scale_rewards=True))]


def cost(rounds: int = 4, steps: int = 1000, methods: tuple[str, ...] = ("lare-bayes", "lare-rrdu")) -> None:
    """Measure a step.

    Args:
        rounds: number of turns of each contender, after one that is not counted.
        steps: environment steps in a turn, a multiple of an episode.
        methods: methods of the plug.
    """
    task = lare_rl.load_task(TASK)
    models = {name: td3(task, name, 0, steps) for name in ("episodic", *methods)}

    def advance(model: TD3, by: int = steps) -> None:
        model.learn(by, reset_num_timesteps=False, log_interval=1_000_000)

    for model in models.values():
        advance(model)
    turns = {name: partial(advance, model) for name, model in models.items()}
    table = summary(interleave(turns, rounds, time.process_time), steps, "episodic")
    show("TD3, processor time", table, "episodic")
    RESULTS.mkdir(parents=True, exist_ok=True)
    figures = {"task": TASK, "seeds": [0], "rounds": rounds, "steps in a turn": steps}
    write("plugs/sb3_cost", {**figures, "processor milliseconds for a step": table})


def learn(
    algorithm: Literal["td3", "ppo", "sbx-sac"] = "td3",
    rewards: str = "lare-bayes",
    task: str = TASK,
    seeds: int = 3,
    steps: int = 100_000,
    evaluate_every: int = 10_000,
    episodes: int = 10,
    warmup: int = 10_000,
) -> None:
    """Train, and append a line of JSON for each evaluation to results/plugs/ALGORITHM-REWARDS.jsonl.

    Args:
        algorithm: the algorithm to train.
        rewards: `episodic`, `dense`, or a method for the plug.
        task: a task of the package.
        seeds: number of seeds, from 0, one after the other.
        steps: environment steps of each seed.
        evaluate_every: environment steps between two evaluations; a multiple of 2000 for ppo.
        episodes: number of episodes in one evaluation.
        warmup: random steps before the first update; ppo has none.
    """
    spec = lare_rl.load_task(task)
    RESULTS.mkdir(parents=True, exist_ok=True)
    out = RESULTS / f"{algorithm}-{rewards}.jsonl"
    with out.open("a") as file:
        print(json.dumps({"task": task, "steps": steps, **provenance()}), file=file)
    true = gymnasium.make(spec.environment)
    for seed in range(seeds):
        callbacks: list[Any] = []
        if algorithm == "ppo":
            model, callbacks = ppo(spec, rewards, seed)
        else:
            model = {"td3": td3, "sbx-sac": sbx_sac}[algorithm](spec, rewards, seed, warmup)
        report = partial(append_evaluation, out, model, true, seed, episodes)
        model.learn(steps, log_interval=1_000_000, callback=[*callbacks, Evaluations(evaluate_every, report)])


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")
    torch.set_num_threads(1)
    tyro.extras.subcommand_cli_from_dict({"cost": cost, "learn": learn}, description=__doc__)
