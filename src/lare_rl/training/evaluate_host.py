"""Evaluates a policy in environments on the host, all episodes at the same time or a few after the others."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lare_rl.envs.play import EpisodeListener
from lare_rl.envs.vec_env import VecEnv
from lare_rl.training.evaluation import Evaluation, concatenate
from lare_rl.training.host_policy import EvaluationPolicy
from lare_rl.training.static_config import TrainConfig
from lare_rl.training.unroll_host import evaluate_on_host

__all__ = ["evaluate_policy_on_host"]


def evaluate_policy_on_host(
    envs: VecEnv,
    config: TrainConfig,
    actor: Any,
    seeds: Sequence[int],
    n_episodes: int,
    first: int = 0,
    on_step: Callable[[], None] = lambda: None,
    on_episode: EpisodeListener = lambda n_done: None,
) -> Evaluation:
    """Evaluate `n_episodes` of each seed's policy. If there are fewer environments, some episodes begin after others.

    An episode does not depend on the number of environments: neither its initial state nor the noise of its actions.

    Args:
        envs: as many environments for each seed.
        config: the configuration of training.
        actor: what acts, of all seeds.
        seeds: the seeds of the run.
        n_episodes: the number of episodes of each seed.
        first: the number of the first episode, which determines its initial state.
        on_step: called before each step of the environments.
        on_episode: called with the number of episodes of each seed, when some have ended.
    """
    width, evaluations = len(envs.batch.terminated) // len(seeds), []
    for start in range(0, n_episodes, width):
        episodes = np.minimum(np.arange(start, start + width), n_episodes - 1)
        policy = EvaluationPolicy(config, actor, seeds, width, noise_rows=(n_episodes, episodes))

        def act(*inputs: Any, policy: EvaluationPolicy = policy) -> np.ndarray:
            on_step()
            return policy(*inputs)

        n_playing = min(width, n_episodes - start)
        evaluations.append(evaluate_on_host(envs, act, seeds, n_playing, first + start))
        on_episode(start + n_playing)
    return concatenate(evaluations)
