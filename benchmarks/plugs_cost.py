"""What each adapter adds to a step: processor milliseconds with `lare-bayes` (`bayes` for PettingZoo), and of the library alone.

    python benchmarks/plugs_cost.py                  results/plugs/cost.json
    python benchmarks/plugs_cost.py --sbx            the same for SBX's SAC, if SBX is installed: results/plugs/cost_sbx.json

A turn is a thousand environment steps of HalfCheetah-v4: one episode ends in it, and one decoder is fitted in closed form. With
PettingZoo it is forty episodes of CN-6. The contenders take turns within one process, on one core:

    Gymnasium            a single environment with random actions, with r_hat at every step
    PettingZoo           six agents with random actions, with r_hat at every step
    TorchRL              a replay buffer: 1,000 rows are stored, then 256 rows are drawn for each of them
    Stable-Baselines3    PPO as in `plugs_sb3.py`, a rollout of two episodes. The cost of its TD3 is measured there
    SBX                  SAC as in `plugs_sb3.py`, with an update at each step
"""

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import gymnasium
import jax
import numpy as np
import torch
import tyro
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

import lare_rl
from lare_rl.envs.particles.parallel_env import ParticleParallelEnv
from lare_rl.integrations.gymnasium import Credit
from lare_rl.integrations.pettingzoo import CreditParallel
from lare_rl.integrations.torchrl import CreditTransform
from measure import interleave, show, summary, write
from plugs_sb3 import TASK, assigner, make_environment, ppo, sbx_sac

STEPS = 1000
PLAIN, PLUG = "plain", "with the plug"

Turns = Mapping[str, Callable[[], object]]


def gymnasium_turns(task: lare_rl.TaskSpec) -> Turns:
    """An episode of random actions."""
    plain = make_environment(task, dense=False)

    def play(environment: gymnasium.Env) -> None:
        environment.reset(seed=0)
        for _ in range(STEPS):
            environment.step(environment.action_space.sample())

    plugged = Credit(make_environment(task, dense=False), assigner("lare-bayes", task, 0))
    return {PLAIN: partial(play, plain), PLUG: partial(play, plugged)}


def pettingzoo_turns() -> Turns:
    """Forty episodes of random actions of six agents."""
    environment = ParticleParallelEnv("CN-6")
    spaces: dict[str, Any] = {
        "observation_space": environment.observation_space("agent_0"),
        "action_space": environment.action_space("agent_0"),
    }
    credit = lare_rl.CreditAssigner("bayes", **spaces, agents=6, max_steps=25)

    def play(environment: Any) -> None:
        for episode in range(STEPS // 25):
            environment.reset(seed=episode)
            while environment.agents:
                environment.step({agent: environment.action_space(agent).sample() for agent in environment.agents})

    return {PLAIN: partial(play, environment), PLUG: partial(play, CreditParallel(ParticleParallelEnv("CN-6"), credit))}


def torchrl_turns(task: lare_rl.TaskSpec) -> Turns:
    """An episode goes into the buffer, and a batch is drawn for each of its steps."""
    environment, rows = make_environment(task, dense=False), []
    observation, _ = environment.reset(seed=0)
    for _ in range(STEPS):
        action = environment.action_space.sample()
        after, reward, terminated, truncated, _ = environment.step(action)
        done = torch.tensor([terminated or truncated])
        ends = {"done": done, "terminated": torch.tensor([terminated]), "truncated": torch.tensor([truncated])}
        next_step = {"observation": torch.tensor(after), "reward": torch.tensor([reward], dtype=torch.float32), **ends}
        rows.append(
            TensorDict({"observation": torch.tensor(observation), "action": torch.tensor(action), "next": next_step})
        )
        observation = after
    episode: Any = torch.stack(rows)

    def train(buffer: TensorDictReplayBuffer) -> None:
        buffer.extend(episode.clone())
        for _ in range(STEPS):
            buffer.sample()

    def buffer(**more: Any) -> TensorDictReplayBuffer:
        return TensorDictReplayBuffer(storage=LazyTensorStorage(100_000), batch_size=256, **more)

    plugged = buffer(transform=CreditTransform(assigner("lare-bayes", task, 0)))
    return {PLAIN: partial(train, buffer()), PLUG: partial(train, plugged)}


def ppo_turns(task: lare_rl.TaskSpec) -> Turns:
    """A rollout, and the updates on it."""

    def learning(rewards: str) -> Callable[[], object]:
        model, callbacks = ppo(task, rewards, 0)
        return lambda: model.learn(STEPS, callback=[*callbacks], reset_num_timesteps=False, log_interval=1_000_000)

    return {PLAIN: learning("episodic"), PLUG: learning("lare-bayes")}


def sbx_turns(task: lare_rl.TaskSpec) -> Turns:
    """A step and an update."""

    def learning(rewards: str) -> Callable[[], object]:
        model = sbx_sac(task, rewards, 0, STEPS)
        model.learn(STEPS)  # random steps, without an update
        return lambda: model.learn(STEPS, reset_num_timesteps=False, log_interval=1_000_000)

    return {PLAIN: learning("episodic"), PLUG: learning("lare-bayes")}


def main(rounds: int = 5, sbx: bool = False) -> None:
    """Measure.

    Args:
        rounds: number of turns of each contender, after one that is not counted.
        sbx: measure only SBX's SAC.
    """
    task = lare_rl.load_task(TASK)
    contenders = {
        "Gymnasium": (partial(gymnasium_turns, task), STEPS),
        "PettingZoo": (pettingzoo_turns, STEPS),
        "TorchRL": (partial(torchrl_turns, task), STEPS),
        "Stable-Baselines3, PPO": (partial(ppo_turns, task), 2000),  # PPO always finishes its rollout of 2,000 steps
    }
    if sbx:
        contenders = {"SBX, SAC": (partial(sbx_turns, task), STEPS)}
    tables = {}
    for name, (turns, steps) in contenders.items():
        tables[name] = summary(interleave(turns(), rounds, time.process_time), steps, PLAIN)
        show(f"{name}, processor time", tables[name], PLAIN)
    figures = {"task": TASK, "seeds": [0], "rounds": rounds, "processor milliseconds for a step": tables}
    write("plugs/cost_sbx" if sbx else "plugs/cost", figures)


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")
    torch.set_num_threads(1)
    np.random.seed(0)
    tyro.cli(main, description=__doc__)
