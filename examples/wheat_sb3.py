"""Nitrogen for wheat, with SAC of Stable-Baselines3: the margin is known at harvest.

pip install -e 'benchmarks/real[wheat]' -e '.[sb3]'
python examples/wheat_sb3.py
"""

import gymnasium
import numpy as np
from stable_baselines3 import SAC

import final_score.wheat
import lare_rl
from final_score.play import make_task, play_scores
from lare_rl.integrations.sb3 import CreditReplayBuffer


def main(steps: int = 4_000, episodes: int = 28) -> tuple[float, float]:
    """Return the mean margin (100 EUR/ha) of held-out seasons: of the policy, and of a rule of thumb."""
    env = gymnasium.make("Wheat-v0")
    credit = lare_rl.CreditAssigner(
        "bayes", observation_space=env.observation_space, action_space=env.action_space, capacity=steps
    )
    buffer = {"replay_buffer_class": CreditReplayBuffer, "replay_buffer_kwargs": {"credit": credit}}
    model = SAC("MlpPolicy", env, buffer_size=steps, learning_starts=400, seed=0, **buffer)
    model.learn(steps)
    print(credit.metrics())
    test = make_task("wheat", "test")
    policy = play_scores(test, lambda env: lambda obs: model.predict(obs, deterministic=True)[0], episodes)
    rule = play_scores(test, final_score.wheat.three_dates, episodes)
    return float(np.mean([score for score, _ in policy])), float(np.mean([score for score, _ in rule]))


if __name__ == "__main__":
    print("margin of held-out seasons: policy {:.1f}, three dates {:.1f}".format(*main()))
