"""Proxy rewards of a latent function in your own training loop.

    python examples/own_loop.py

Actions are random, and no policy is trained. The script prints the correlation of r_hat with the true rewards,
which the assigner never receives.
"""

import gymnasium
import numpy as np

import lare_rl


def main(episodes: int = 40) -> float:
    """Play. Gives the correlation of r_hat with the true rewards of the last episode."""
    task = lare_rl.load_task("HalfCheetah-v4")
    phi = lare_rl.design(
        task
    )  # from the recorded replies; `lare_rl.load_function("phi.py", task)` for your own function
    credit = lare_rl.CreditAssigner("lare-bayes", phi, task=task)
    environment = lare_rl.EpisodicReward(gymnasium.make(task.environment))  # pays at the end of an episode
    environment.action_space.seed(0)
    r_hat, true = np.zeros(0), []
    for number in range(episodes):
        before, _ = environment.reset(seed=number)
        steps, true, over = [], [], False
        while not over:
            action = environment.action_space.sample()
            after, reward, terminated, truncated, info = environment.step(action)
            steps += credit.add([before], [action], [after], [reward], [terminated], [truncated]).tolist()
            true.append(info["true_reward"])  # used only by the last line of this function
            before, over = after, terminated or truncated
        r_hat = credit.rewards_at(steps)  # your algorithm trains on these; ask again whenever it samples
    return float(np.corrcoef(r_hat, true)[0, 1])


if __name__ == "__main__":
    print(f"correlation of r_hat with the true rewards of the last episode: {main():.2f}")
