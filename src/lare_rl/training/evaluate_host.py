"""Plays episodes of a policy in environments on the host, all episodes at the same time or a few after the others."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from lare_rl.envs.play import EpisodeListener
from lare_rl.envs.vec_env import VecEnv
from lare_rl.training.evaluation import Evaluation, concatenate
from lare_rl.training.host_policy import EvaluationPolicy
from lare_rl.training.static_config import TrainConfig
from lare_rl.training.unroll_host import evaluate_on_host

__all__ = ["evaluate_policy_on_host", "policy_turns"]


def policy_turns(
    envs: VecEnv,
    config: TrainConfig,
    actor: Any,
    seeds: Sequence[int],
    n_episodes: int,
    deterministic: bool | None = None,
) -> Iterator[tuple[range, EvaluationPolicy]]:
    """Yield the numbers of the episodes that begin together, and their policy, until each seed has `n_episodes`.

    If there are fewer environments, some episodes begin after others. The noise of an episode does not depend on that.
    """
    width = len(envs.batch.terminated) // len(seeds)
    for start in range(0, n_episodes, width):
        rows = np.minimum(np.arange(start, start + width), n_episodes - 1)
        policy = EvaluationPolicy(config, actor, seeds, width, deterministic, noise_rows=(n_episodes, rows))
        yield range(start, min(start + width, n_episodes)), policy


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
    """Evaluate `n_episodes` of each seed's policy. An episode does not depend on the number of environments.

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
    evaluations = []
    for numbers, policy in policy_turns(envs, config, actor, seeds, n_episodes):

        def act(*inputs: Any, policy: EvaluationPolicy = policy) -> np.ndarray:
            on_step()
            return policy(*inputs)

        evaluations.append(evaluate_on_host(envs, act, seeds, len(numbers), first + numbers.start))
        on_episode(numbers.stop)
    return concatenate(evaluations)
