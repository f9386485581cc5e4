"""TD3+BC on logged episodes (Fujimoto and Gu, 2021), in one file, in the style of CORL.

    lare-rl relabel DATASET --out NEW
    python examples/offline_td3_bc.py NEW --rewards rewards --environment Pendulum-v1     # on r_hat
    python examples/offline_td3_bc.py NEW --rewards paid                                  # on the rewards of the log
    python examples/offline_td3_bc.py NEW --rewards end                                   # on the return, at the end

NEW is the output of `lare-rl relabel`: a directory of .npz files, or a Minari id. Actions must be rows of numbers.
"""

import argparse
import copy

import gymnasium
import numpy as np
import torch
from torch import nn
from torch.nn import functional

from lare_rl.logs.open_log import open_log

BATCH, GAMMA, TAU, ALPHA, NOISE, CLIP, DELAY = 256, 0.99, 0.005, 2.5, 0.2, 0.5, 2


def network(inputs: int, outputs: int) -> nn.Module:
    return nn.Sequential(nn.Linear(inputs, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, outputs))


def transitions(dataset: str, rewards: str) -> dict[str, torch.Tensor]:
    """All steps of a data set, in memory: before, action, after, reward, terminated."""
    columns: dict[str, list[np.ndarray]] = {key: [] for key in ("before", "action", "after", "reward", "over")}
    for episode in open_log(dataset).episodes():
        steps, contents = len(episode), episode.contents
        if rewards == "end":
            reward = np.append(np.zeros(steps - 1), episode.reward.sum())
        else:
            reward = episode.reward if rewards == "paid" else np.asarray(contents["rewards"], np.float32)
        over = np.arange(steps) == steps - 1
        if "terminations" in contents:
            over &= np.asarray(contents["terminations"], bool)
        for key, values in zip(
            columns, (episode.observation, episode.action, episode.next_observation, reward, over), strict=True
        ):
            columns[key].append(values)
    return {
        key: torch.as_tensor(np.concatenate(values_list), dtype=torch.float32) for key, values_list in columns.items()
    }


class TD3BC:
    """Two critics, and an actor that stays near the actions of the data."""

    def __init__(self, entries: int, actions: int, largest: float):
        self.largest = largest
        self.actor = network(entries, actions)
        self.critics = nn.ModuleList([network(entries + actions, 1) for _ in range(2)])
        self.old_actor, self.old_critics = copy.deepcopy(self.actor), copy.deepcopy(self.critics)
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), 3e-4)
        self.critic_optimizer = torch.optim.Adam(self.critics.parameters(), 3e-4)

    def act(self, observation: torch.Tensor, old: bool = False) -> torch.Tensor:
        return self.largest * torch.tanh((self.old_actor if old else self.actor)(observation))

    def values(self, observation: torch.Tensor, action: torch.Tensor, old: bool = False) -> list[torch.Tensor]:
        rows = torch.cat([observation, action], dim=1)
        return [critic(rows)[:, 0] for critic in (self.old_critics if old else self.critics)]

    def update(self, batch: dict[str, torch.Tensor], number: int) -> None:
        with torch.no_grad():
            noise = (NOISE * torch.randn_like(batch["action"])).clamp(-CLIP, CLIP) * self.largest
            action = (self.act(batch["after"], old=True) + noise).clamp(-self.largest, self.largest)
            value = torch.minimum(*self.values(batch["after"], action, old=True))
            target = batch["reward"] + GAMMA * (1 - batch["over"]) * value
        loss = sum(
            functional.mse_loss(values_list, target) for values_list in self.values(batch["before"], batch["action"])
        )
        step(self.critic_optimizer, loss)  # pyright: ignore[reportArgumentType] - a sum of tensors
        if number % DELAY:
            return
        action = self.act(batch["before"])
        value = self.values(batch["before"], action)[0]
        weight = ALPHA / value.abs().mean().detach()
        step(self.actor_optimizer, -weight * value.mean() + functional.mse_loss(action, batch["action"]))
        for new, old in ((self.actor, self.old_actor), (self.critics, self.old_critics)):
            for values_list, other in zip(new.parameters(), old.parameters(), strict=True):
                other.data.lerp_(values_list.data, TAU)


def step(optimizer: torch.optim.Optimizer, loss: torch.Tensor) -> None:
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


def evaluate(agent: TD3BC, environment: gymnasium.Env, mean: torch.Tensor, deviation: torch.Tensor) -> float:
    """Mean return of five episodes."""
    total = 0.0
    for seed in range(5):
        observation, _ = environment.reset(seed=seed)
        over = False
        while not over:
            with torch.no_grad():
                row = (torch.as_tensor(observation, dtype=torch.float32) - mean) / deviation
                action = agent.act(row[None])[0].numpy()
            observation, reward, terminated, truncated, _ = environment.step(action)
            total, over = total + float(reward), terminated or truncated
    return total / 5


def main(
    dataset: str, rewards: str = "rewards", steps: int = 100_000, environment: str | None = None, seed: int = 0
) -> list[float]:
    torch.manual_seed(seed)
    data = transitions(dataset, rewards)
    mean, deviation = data["before"].mean(dim=0), data["before"].std(dim=0) + 1e-3
    for key in ("before", "after"):
        data[key] = (data[key] - mean) / deviation
    data["reward"] /= data["reward"].std() + 1e-6  # all three kinds of rewards in one unit
    agent = TD3BC(data["before"].shape[1], data["action"].shape[1], float(data["action"].abs().max()))
    played, returns = None if environment is None else gymnasium.make(environment), []
    for number in range(steps):
        indices = torch.randint(len(data["reward"]), (BATCH,))
        agent.update({key: values[indices] for key, values in data.items()}, number)
        if played is not None and (number + 1) % max(1, steps // 5) == 0:
            returns.append(evaluate(agent, played, mean, deviation))
            print(f"{number + 1} updates: return {returns[-1]:.1f}")
    return returns


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("dataset")
    parser.add_argument("--rewards", choices=["rewards", "paid", "end"], default="rewards")
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--environment")
    parser.add_argument("--seed", type=int, default=0)
    main(**vars(parser.parse_args()))
