"""Latent rewards in a training loop of your own, whatever it is made of.

    python examples/own_loop.py

Here actions are random and nothing is trained: what is printed is how near r_hat comes to rewards that were never shown.
"""

import gymnasium
import numpy as np

import lare


def main(episodes: int = 40) -> float:
    """Play; the correlation of r_hat with the true rewards of the last episode."""
    task = lare.load_task("HalfCheetah-v4")
    phi = lare.design(task)  # from the recorded replies; `lare.load_function("phi.py", task)` for one of your own
    credit = lare.CreditAssigner("lare-bayes", phi, task=task)
    environment = lare.EpisodicReward(gymnasium.make(task.environment))  # pays at the end of an episode
    environment.action_space.seed(0)
    r_hat, true = np.zeros(0), []
    for number in range(episodes):
        before, _ = environment.reset(seed=number)
        steps, true, over = [], [], False
        while not over:
            action = environment.action_space.sample()
            after, paid, terminated, truncated, info = environment.step(action)
            steps += credit.add([before], [action], [after], [paid], [terminated], [truncated]).tolist()
            true.append(info["true_reward"])  # which only the last line looks at
            before, over = after, terminated or truncated
        r_hat = credit.rewards_at(steps)  # what your algorithm trains on: asked for anew whenever it samples
    credit.close()
    return float(np.corrcoef(r_hat, true)[0, 1])


if __name__ == "__main__":
    print(f"correlation of r_hat with the true rewards of the last episode: {main():.2f}")
