"""Episodes of a trained policy with noise, and how well a method finds the rewards of their steps.

The policy is that of `examples/trained`. The strength of its noise differs between episodes, and so do their returns.
"""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import gymnasium
import numpy as np
from jaxtyping import Float

import lare_rl
from lare_rl.credit.decoder_settings import CreditSettings
from measure import correlation, fit_once, record_episodes

POLICY = Path(__file__).parent.parent / "examples" / "trained" / "HalfCheetah-v4"
METHODS = "bayes", "lare-bayes", "bayes-history", "lare-bayes-history", "bayes-progress", "lare-bayes-progress"
MAX_NOISE = 1.0

Episode = dict[str, Float[np.ndarray, "steps *entries"]]


def play(env: gymnasium.Env, n_episodes: int, seed: int, info_names: tuple[str, ...] = ()) -> list[Episode]:
    """Return episodes of the noisy policy, with these values of `info`."""
    sys.path.insert(0, str(POLICY))
    import exported

    policy, rng = exported.load("policy"), np.random.default_rng(seed)

    def add_noise() -> Callable[[np.ndarray], np.ndarray]:
        noise = rng.uniform(0, MAX_NOISE)
        return lambda obs: np.clip(policy(observation=obs)["action"] + noise * rng.normal(size=6), -1, 1)

    episodes = record_episodes(env, range(1000 * seed, 1000 * seed + n_episodes), add_noise, info_names)
    return [{name: values.astype(np.float32) for name, values in e.items()} for e in episodes]


def assess(
    task: str,
    method: str,
    train: Sequence[Episode],
    test: Sequence[Episode],
    truth: str,
    score: Literal["auto", "binary"] = "auto",
) -> float:
    """Fit a method to the returns of some episodes, and correlate its rewards of other episodes with their entry `truth`."""
    phi = lare_rl.design(task) if method.startswith("lare-") else None
    credit = lare_rl.CreditAssigner(method, phi, task=task, settings=CreditSettings(score=score))
    half = len(train) // 2
    for batch in train[:half], train[half:]:  # predictions of the second decide whether odds are fitted
        fit_once(credit, batch)
    arrays = {name: np.concatenate([episode[name] for episode in test]) for name in test[0]}
    begins = np.concatenate([np.arange(len(episode["reward"])) == 0 for episode in test])
    r_hat = credit.rewards(arrays["observation"], arrays["action"], arrays["next_observation"], begins=begins)
    return correlation(r_hat, arrays[truth])
