"""PPO in a single file, after CleanRL's `ppo_continuous_action.py`, trained on the proxy rewards of LaRe.

    python examples/cleanrl_ppo.py --env-id HalfCheetah-v5
    python examples/cleanrl_ppo.py --method dense   # the rewards of the environment

LaRe adds only the lines that end in `# LaRe`.
"""
# The types of spaces and modules are imprecise here, as in CleanRL.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false, reportOperatorIssue=false
# pyright: reportPossiblyUnboundVariable=false, reportOptionalIterable=false

import random
import time
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import torch
import torch.nn as nn
import tyro
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.utils import RunningMeanStd
from torch import optim
from torch.distributions.normal import Normal

import lare_rl  # LaRe
from lare_rl.integrations.gymnasium import VectorCredit  # LaRe


@dataclass
class Args:
    seed: int = 1
    env_id: str = "HalfCheetah-v4"
    total_timesteps: int = 1_000_000
    learning_rate: float = 3e-4
    num_envs: int = 1
    num_steps: int = 2048
    gamma: float = 0.99
    gae_lambda: float = 0.95
    num_minibatches: int = 32
    update_epochs: int = 10
    clip_coef: float = 0.2
    ent_coef: float = 0.0
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5
    method: str = "lare-bayes"  # LaRe


def layer_init(layer, std=2**0.5, bias_const=0.0):
    nn.init.orthogonal_(layer.weight, std)
    nn.init.constant_(layer.bias, bias_const)
    return layer


class Agent(nn.Module):
    def __init__(self, envs):
        super().__init__()
        inputs = int(np.prod(envs.single_observation_space.shape))
        outputs = int(np.prod(envs.single_action_space.shape))
        self.critic = nn.Sequential(
            layer_init(nn.Linear(inputs, 64)),
            nn.Tanh(),
            layer_init(nn.Linear(64, 64)),
            nn.Tanh(),
            layer_init(nn.Linear(64, 1), std=1.0),
        )
        self.actor_mean = nn.Sequential(
            layer_init(nn.Linear(inputs, 64)),
            nn.Tanh(),
            layer_init(nn.Linear(64, 64)),
            nn.Tanh(),
            layer_init(nn.Linear(64, outputs), std=0.01),
        )
        self.actor_logstd = nn.Parameter(torch.zeros(1, outputs))

    def get_value(self, x):
        return self.critic(x)

    def get_action_and_value(self, x, action=None):
        mean = self.actor_mean(x)
        probs = Normal(mean, torch.exp(self.actor_logstd.expand_as(mean)))
        action = probs.sample() if action is None else action
        return action, probs.log_prob(action).sum(1), probs.entropy().sum(1), self.critic(x)


def main(args: Args) -> list[float]:
    """Train. Gives the returns of the episodes (sums of the rewards of the environment)."""
    batch_size = args.num_envs * args.num_steps
    minibatch_size = batch_size // args.num_minibatches
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
        credit = lare_rl.CreditAssigner(args.method, phi, task=task, **spaces, scale_rewards=True)  # LaRe
        envs = VectorCredit(envs, credit, pay="environment")  # LaRe
    envs = gym.wrappers.vector.ClipAction(envs)
    envs = gym.wrappers.vector.NormalizeReward(envs, gamma=args.gamma)
    obs_rms = RunningMeanStd(shape=envs.single_observation_space.shape)

    def normalised(observations):
        obs_rms.update(observations)
        scaled = (observations - obs_rms.mean) / np.sqrt(obs_rms.var + 1e-8)
        return torch.as_tensor(scaled.clip(-10, 10), dtype=torch.float32)

    agent = Agent(envs)
    optimizer = optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5)

    obs = torch.zeros((args.num_steps, args.num_envs, *envs.single_observation_space.shape))
    actions = torch.zeros((args.num_steps, args.num_envs, *envs.single_action_space.shape))
    logprobs, rewards, dones, values = torch.zeros((4, args.num_steps, args.num_envs)).unbind()
    steps = np.zeros((args.num_steps, args.num_envs), int)  # LaRe

    returns, global_step, start_time = [], 0, time.time()
    next_obs, _ = envs.reset(seed=args.seed)
    next_obs = normalised(next_obs)
    next_done = torch.zeros(args.num_envs)
    for iteration in range(1, args.total_timesteps // batch_size + 1):
        optimizer.param_groups[0]["lr"] = args.learning_rate * (1 - (iteration - 1) * batch_size / args.total_timesteps)
        for step in range(args.num_steps):
            global_step += args.num_envs
            obs[step], dones[step] = next_obs, next_done
            with torch.no_grad():
                action, logprobs[step], _, value = agent.get_action_and_value(next_obs)
                values[step] = value.flatten()
            actions[step] = action

            next_obs, reward, terminations, truncations, infos = envs.step(action.numpy())
            rewards[step] = torch.as_tensor(reward)
            steps[step] = infos.get("credit_step", 0)  # LaRe
            next_obs, next_done = normalised(next_obs), torch.as_tensor(terminations | truncations).float()
            for idx in np.flatnonzero(terminations | truncations):
                returns.append(float(infos["episode"]["r"][idx]))
                print(f"global_step={global_step}, episodic_return={returns[-1]:.1f}")

        if args.method != "dense":  # LaRe
            credit.fit()  # LaRe
            rewards[:] = torch.as_tensor(credit.rewards_at(steps))  # LaRe
            print(credit.metrics())  # LaRe
        with torch.no_grad():
            next_value = agent.get_value(next_obs).flatten()
            advantages, lastgaelam = torch.zeros_like(rewards), 0
            for t in reversed(range(args.num_steps)):
                last = t == args.num_steps - 1
                nextnonterminal = 1.0 - (next_done if last else dones[t + 1])
                nextvalues = next_value if last else values[t + 1]
                delta = rewards[t] + args.gamma * nextvalues * nextnonterminal - values[t]
                lastgaelam = delta + args.gamma * args.gae_lambda * nextnonterminal * lastgaelam
                advantages[t] = lastgaelam

        b_obs, b_actions = obs.flatten(0, 1), actions.flatten(0, 1)
        b_logprobs, b_values = logprobs.flatten(), values.flatten()
        b_advantages, b_returns = advantages.flatten(), (advantages + values).flatten()
        for _ in range(args.update_epochs):
            b_inds = np.random.permutation(batch_size)
            for start in range(0, batch_size, minibatch_size):
                mb_inds = b_inds[start : start + minibatch_size]
                _, newlogprob, entropy, newvalue = agent.get_action_and_value(b_obs[mb_inds], b_actions[mb_inds])
                ratio = (newlogprob - b_logprobs[mb_inds]).exp()
                mb_advantages = b_advantages[mb_inds]
                mb_advantages = (mb_advantages - mb_advantages.mean()) / (mb_advantages.std() + 1e-8)
                clipped = torch.clamp(ratio, 1 - args.clip_coef, 1 + args.clip_coef)
                pg_loss = torch.max(-mb_advantages * ratio, -mb_advantages * clipped).mean()

                newvalue = newvalue.view(-1)
                v_clipped = b_values[mb_inds] + torch.clamp(
                    newvalue - b_values[mb_inds], -args.clip_coef, args.clip_coef
                )
                v_loss = (
                    0.5 * torch.max((newvalue - b_returns[mb_inds]) ** 2, (v_clipped - b_returns[mb_inds]) ** 2).mean()
                )
                loss = pg_loss - args.ent_coef * entropy.mean() + v_loss * args.vf_coef
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
                optimizer.step()
        print(f"SPS={int(global_step / (time.time() - start_time))}")

    envs.close()
    return returns


if __name__ == "__main__":
    main(tyro.cli(Args))
