"""Latent rewards in a training loop of your own, whatever it is made of.

    python examples/own_loop.py

The pieces are pure functions: `phi` judges the steps of an episode, a decoder is fitted to what episodes returned, and r_hat
is what your algorithm trains on instead of a reward. Here actions are random and nothing is trained: what is printed is how
near r_hat comes to rewards that the decoder was never shown.
"""

from functools import partial

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

import lare
from lare.credit import decomposition, descent
from lare.credit.decomposition import CreditSettings
from lare.credit.methods import Fit, find_method
from lare.tasks.episodic import TRUE_REWARD

TASK, METHOD, SETTINGS = lare.load_task("HalfCheetah-v4"), find_method("lare-rd"), CreditSettings(hidden=(64, 64))
BATCH, LONGEST = 4, 1000
"""Episodes in one update of the decoder, and the steps of the longest one."""


def play(environment: gymnasium.Env, phi: lare.LatentFunction) -> tuple[np.ndarray, float, np.ndarray]:
    """One episode: its factors (T, d), its return, and the true rewards (T,), which only the last line of `main` looks at."""
    observation, _ = environment.reset()
    steps, paid, over = [], 0.0, False
    while not over:
        action = environment.action_space.sample()
        after, reward, terminated, truncated, info = environment.step(action)
        steps.append((observation, action, after, info[TRUE_REWARD]))
        observation, paid, over = after, paid + float(reward), terminated or truncated
    before, action, after, true = (np.array(one, np.float32) for one in zip(*steps, strict=True))
    return phi.of_steps(before, action, after, TASK.judges), paid, true


def main(episodes: int = 40, updates: int = 50) -> float:
    """Play, and fit after every episode; the correlation of r_hat with the true rewards of one more."""
    environment = lare.EpisodicReward(gymnasium.make(TASK.environment))  # pays at the end of an episode
    environment.reset(seed=0)
    environment.action_space.seed(0)
    phi = lare.design(TASK)  # from the recorded replies; `lare.load_function("phi.py", TASK)` for one of your own
    draw = np.random.default_rng(0)

    credit = decomposition.init(jax.random.key(0), phi.size, METHOD, SETTINGS, steps=LONGEST, agents=1)
    fit = jax.jit(partial(descent.update, fit=Fit.ALL_STEPS, settings=SETTINGS))
    reward = partial(decomposition.proxy_rewards, settings=SETTINGS)
    stored: list[tuple[np.ndarray, float]] = []
    for number in range(episodes):
        z, paid, _ = play(environment, phi)
        stored.append((z, paid))
        credit = decomposition.observe_steps(credit, jnp.asarray(z))
        credit = decomposition.observe_returns(
            credit, jnp.array([paid / len(z)]), jnp.array([len(z)]), jnp.array([True])
        )
        for key in jax.random.split(jax.random.key(number), updates):
            features, returns = zip(*(stored[one] for one in draw.integers(len(stored), size=BATCH)), strict=True)
            credit, _ = fit(credit, decomposition.whole_episodes(features, returns, BATCH * LONGEST), key)
        r_hat = reward(credit, jnp.asarray(z))
        # Here your algorithm trains. An on-policy one takes this r_hat for its newest episode; one with a replay buffer keeps z,
        # not r_hat, and asks again for whatever it draws: by the newest decoder, for what the decoder said before is stale.

    z, _, true = play(environment, phi)
    r_hat = reward(credit, jnp.asarray(z))
    environment.close()
    phi.close()
    return float(np.corrcoef(r_hat, true)[0, 1])


if __name__ == "__main__":
    print(f"correlation of r_hat with the true rewards of an episode that the decoder has not seen: {main():.2f}")
