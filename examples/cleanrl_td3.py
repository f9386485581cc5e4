"""TD3 in a single file, after CleanRL's `td3_continuous_action.py`, trained on the proxy rewards of LaRe.

    python examples/cleanrl_td3.py --env-id HalfCheetah-v5
    python examples/cleanrl_td3.py --method dense   # the rewards of the environment

LaRe adds only the lines that end in `# LaRe`.
"""
# The types of spaces and modules are imprecise here, as in CleanRL.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false, reportOperatorIssue=false
# pyright: reportPossiblyUnboundVariable=false, reportOptionalIterable=false

import random
import time
from dataclasses import dataclass
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F  # noqa: N812
import tyro
from gymnasium.vector import AutoresetMode
from torch import optim

import lare_rl  # LaRe
from lare_rl.integrations.gymnasium import VectorCredit  # LaRe


@dataclass
class Args:
    seed: int = 1
    env_id: str = "HalfCheetah-v4"
    total_timesteps: int = 1_000_000
    learning_rate: float = 3e-4
    num_envs: int = 1
    buffer_size: int = 1_000_000
    gamma: float = 0.99
    tau: float = 0.005
    batch_size: int = 256
    policy_noise: float = 0.2
    exploration_noise: float = 0.1
    learning_starts: int = 25_000
    policy_frequency: int = 2
    noise_clip: float = 0.5
    method: str = "lare-bayes"  # LaRe


class Sample(NamedTuple):
    observations: torch.Tensor
    actions: torch.Tensor
    next_observations: torch.Tensor
    dones: torch.Tensor
    rewards: torch.Tensor


class ReplayBuffer:
    def __init__(self, size, observation_space, action_space):
        self.size, self.added = size, 0
        shapes = observation_space.shape, action_space.shape, observation_space.shape, (), ()
        self.columns = [np.zeros((size, *shape), np.float32) for shape in shapes]

    def add(self, *values):
        rows = np.arange(self.added, self.added + len(values[0])) % self.size
        for column, value in zip(self.columns, values, strict=True):
            column[rows] = value
        self.added += len(rows)

    def sample(self, batch_size):
        rows = np.random.randint(min(self.added, self.size), size=batch_size)
        return Sample(*(torch.as_tensor(column[rows]) for column in self.columns))


class QNetwork(nn.Module):
    def __init__(self, envs):
        super().__init__()
        inputs = np.prod(envs.single_observation_space.shape) + np.prod(envs.single_action_space.shape)
        self.fc1 = nn.Linear(int(inputs), 256)
        self.fc2 = nn.Linear(256, 256)
        self.fc3 = nn.Linear(256, 1)

    def forward(self, x, a):
        x = torch.cat([x, a], 1)
        x = F.relu(self.fc1(x))
        x = F.relu(self.fc2(x))
        return self.fc3(x)


class Actor(nn.Module):
    def __init__(self, envs):
        super().__init__()
        space = envs.single_action_space
        self.fc1 = nn.Linear(int(np.prod(envs.single_observation_space.shape)), 256)
        self.fc2 = nn.Linear(256, 256)
        self.fc_mu = nn.Linear(256, int(np.prod(space.shape)))
        self.register_buffer("action_scale", torch.tensor((space.high - space.low) / 2, dtype=torch.float32))
        self.register_buffer("action_bias", torch.tensor((space.high + space.low) / 2, dtype=torch.float32))

    def forward(self, x):
        x = F.relu(self.fc1(x))
        x = F.relu(self.fc2(x))
        return torch.tanh(self.fc_mu(x)) * self.action_scale + self.action_bias


def main(args: Args) -> list[float]:
    """Train. Gives the returns of the episodes (sums of the rewards of the environment)."""
    random.seed(args.seed)
    np.random.seed(args.seed)
    torch.manual_seed(args.seed)

    envs = gym.vector.SyncVectorEnv(
        [lambda: gym.make(args.env_id)] * args.num_envs, autoreset_mode=AutoresetMode.SAME_STEP
    )
    envs = gym.wrappers.vector.RecordEpisodeStatistics(envs)
    if args.method != "dense":  # LaRe
        task = lare_rl.load_task(args.env_id) if args.method.startswith("lare-") else None  # LaRe
        phi = lare_rl.design(task) if task else None  # LaRe
        spaces = {"observation_space": envs.single_observation_space, "action_space": envs.single_action_space}  # LaRe
        credit = lare_rl.CreditAssigner(args.method, phi, task=task, **spaces, capacity=args.buffer_size)  # LaRe
        envs = VectorCredit(envs, credit, pay="environment")  # LaRe

    actor, target_actor = Actor(envs), Actor(envs)
    qf1, qf2, qf1_target, qf2_target = (QNetwork(envs) for _ in range(4))
    target_actor.load_state_dict(actor.state_dict())
    qf1_target.load_state_dict(qf1.state_dict())
    qf2_target.load_state_dict(qf2.state_dict())
    q_optimizer = optim.Adam(list(qf1.parameters()) + list(qf2.parameters()), lr=args.learning_rate)
    actor_optimizer = optim.Adam(list(actor.parameters()), lr=args.learning_rate)
    low, high = envs.single_action_space.low, envs.single_action_space.high
    low_tensor, high_tensor = torch.as_tensor(low), torch.as_tensor(high)

    rb = ReplayBuffer(args.buffer_size, envs.single_observation_space, envs.single_action_space)
    returns, start_time = [], time.time()
    envs.action_space.seed(args.seed)
    obs, _ = envs.reset(seed=args.seed)
    for global_step in range(0, args.total_timesteps, args.num_envs):
        # Choose actions.
        if global_step < args.learning_starts:
            actions = envs.action_space.sample()
        else:
            with torch.no_grad():
                actions = actor(torch.as_tensor(obs, dtype=torch.float32))
                actions += torch.normal(0, actor.action_scale.expand_as(actions) * args.exploration_noise)
                actions = actions.numpy().clip(low, high)

        next_obs, rewards, terminations, truncations, infos = envs.step(actions)

        # After the last step of an episode, `next_obs` is the first observation of the next episode: use `final_obs`.
        real_next_obs = next_obs.copy()
        for idx in np.flatnonzero(terminations | truncations):
            real_next_obs[idx] = infos["final_obs"][idx]
            returns.append(float(infos["episode"]["r"][idx]))
            print(f"global_step={global_step}, episodic_return={returns[-1]:.1f}")
        rb.add(obs, actions, real_next_obs, terminations, rewards)
        obs = next_obs

        if global_step > args.learning_starts:
            data = rb.sample(args.batch_size)
            if args.method != "dense":  # LaRe
                credit.fit_pending()  # LaRe
                data = data._replace(rewards=torch.as_tensor(credit.rewards(*data[:3])))  # LaRe
            with torch.no_grad():
                noise = torch.randn_like(data.actions) * args.policy_noise
                noise = noise.clamp(-args.noise_clip, args.noise_clip) * target_actor.action_scale
                next_actions = (target_actor(data.next_observations) + noise).clamp(low_tensor, high_tensor)
                qf1_next = qf1_target(data.next_observations, next_actions)
                qf2_next = qf2_target(data.next_observations, next_actions)
                min_qf_next = torch.min(qf1_next, qf2_next).view(-1)
                next_q_value = data.rewards + (1 - data.dones) * args.gamma * min_qf_next

            qf1_a_values = qf1(data.observations, data.actions).view(-1)
            qf2_a_values = qf2(data.observations, data.actions).view(-1)
            qf_loss = F.mse_loss(qf1_a_values, next_q_value) + F.mse_loss(qf2_a_values, next_q_value)
            q_optimizer.zero_grad()
            qf_loss.backward()
            q_optimizer.step()

            if global_step % args.policy_frequency == 0:
                actor_loss = -qf1(data.observations, actor(data.observations)).mean()
                actor_optimizer.zero_grad()
                actor_loss.backward()
                actor_optimizer.step()
                for net, target in ((actor, target_actor), (qf1, qf1_target), (qf2, qf2_target)):
                    for param, target_param in zip(net.parameters(), target.parameters(), strict=True):
                        target_param.data.copy_(args.tau * param.data + (1 - args.tau) * target_param.data)

            if global_step % 1000 == 0:
                print(f"SPS={int(global_step / (time.time() - start_time))}")
                if args.method != "dense":  # LaRe
                    print(credit.metrics())  # LaRe

    envs.close()
    return returns


if __name__ == "__main__":
    main(tyro.cli(Args))
