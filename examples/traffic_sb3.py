"""A traffic signal in Ingolstadt, with PPO of Stable-Baselines3: the mean delay is known at the end of the hour.

pip install -e 'benchmarks/real[traffic]' -e '.[sb3]'
python examples/traffic_sb3.py
"""

from pathlib import Path

import gymnasium
import numpy as np
from stable_baselines3 import PPO

import final_score.traffic
import lare_rl
from final_score.play import make_task, play_scores
from lare_rl.integrations.sb3 import CreditCallback

REAL = Path(__file__).parent.parent / "benchmarks" / "real"


def main(steps: int = 14_400, episodes: int = 4) -> tuple[float, float]:
    """Return the mean score (minus the delay in s) of held-out hours: of the policy, and of a rule of thumb."""
    env = gymnasium.make("Traffic-v0")
    task = lare_rl.load_task(REAL / "tasks" / "traffic.toml")
    phi = lare_rl.load_function(REAL / "phi" / "traffic.py", task)  # by a language model
    credit = lare_rl.CreditAssigner("lare-bayes", phi, task=task, capacity=2 * steps)
    model = PPO("MlpPolicy", env, n_steps=min(720, steps), batch_size=72, seed=0)
    model.learn(steps, callback=CreditCallback(credit))
    print(credit.metrics())
    test = make_task("traffic", "test")
    policy = play_scores(test, lambda env: lambda obs: model.predict(obs, deterministic=False)[0], episodes)
    rule = play_scores(test, final_score.traffic.longest_queue, episodes)
    means = [float(np.mean([score for score, _ in scores])) for scores in (policy, rule)]
    env.close()
    test.close()
    return means[0], means[1]


if __name__ == "__main__":
    print("score of held-out hours: policy {:.1f}, longest queue {:.1f}".format(*main()))
