"""Play an episode with the trained run in HalfCheetah-v4/, whose policy and rewards need NumPy only."""

import sys
from pathlib import Path

import gymnasium

sys.path.insert(0, str(Path(__file__).parent / "HalfCheetah-v4"))
import exported

policy = exported.load("policy")
environment = gymnasium.make("HalfCheetah-v4")
observation, _ = environment.reset(seed=0)
true_return = proxy_return = 0.0
truncated = False
while not truncated:
    action = policy(observation=observation)["action"]
    next_observation, reward, _, truncated, _ = environment.step(action)
    true_return += float(reward)
    proxy_return += float(exported.reward(observation, action, next_observation))
    observation = next_observation
print(f"return {true_return:.0f}, sum of the proxy rewards {proxy_return:.0f}")
