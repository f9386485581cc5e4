"""The lines of `lare-rl evaluate`: the returns of a run's policy, and those of random and of the most likely actions."""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from jaxtyping import Float

from lare_rl.envs.load import check_environment
from lare_rl.envs.placement import load_env_spec
from lare_rl.envs.play import Episode, EpisodeListener
from lare_rl.evaluation.evaluate import (
    RANDOM_EPISODES,
    RANDOM_PLAY_S,
    evaluate_actor,
    evaluation_seeds,
    gain_over_random,
    mean_with_error,
    play_random,
)
from lare_rl.runs.directory import Run
from lare_rl.tasks.spec import TaskSpec
from lare_rl.training.evaluation import Evaluation
from lare_rl.training.saved_state import load_actor
from lare_rl.util.findings import format_for_reader
from lare_rl.util.rounding import round_up
from lare_rl.util.statistics import CLEAR_ERRORS, format_mean_std, format_plus_minus

__all__ = ["describe_evaluation", "evaluation_lines"]


def evaluation_lines(
    run: Run, episodes: int, best: bool, deterministic: bool, make_listener: Callable[[int], EpisodeListener]
) -> Iterator[str]:
    """Play episodes by the policy, by random actions and, for a policy that samples, by the most likely actions. Yield the results.

    The arguments are those of `evaluate_run`. `make_listener` takes the number of episodes that will be played, and returns a function
    that is called with the number that have ended.
    """
    task = run.config.task
    check_environment(task)
    saved = load_actor(run, best)
    start = time.monotonic()
    evaluation = evaluate_actor(run, saved, episodes, deterministic, make_listener(episodes))
    policy_s = time.monotonic() - start
    samples = not (deterministic or saved.config.deterministic_evaluation)
    likeliest = evaluate_actor(run, saved, episodes, True, make_listener(episodes)) if samples else None
    best_steps, seeds = saved.steps.tolist() if best else None, evaluation_seeds(run, episodes)
    # With groups, every seed equally often, because groups may differ in their returns.
    n_random = max(episodes, RANDOM_EPISODES) if task.group is None else round_up(RANDOM_EPISODES, len(seeds))
    random_episodes = play_random(task, n_random, max(policy_s, RANDOM_PLAY_S), make_listener(n_random), seeds)
    yield from describe_evaluation(run, evaluation, random_episodes, best_steps)
    if len(random_episodes[0]) < n_random:
        yield f"random actions played {len(random_episodes[0])} of {n_random} episodes: they are slow, or the environment failed"
    if likeliest is not None:
        yield "The policy samples its actions, as in training. The most likely ones (--deterministic), from the same states:"
        yield from _describe_returns(run, likeliest, best_steps)
        yield from _compare_actions(run, evaluation, likeliest)


def describe_evaluation(
    run: Run, evaluation: Evaluation, random_episodes: Sequence[Sequence[Episode]], best_steps: Sequence[int] | None
) -> Iterator[str]:
    """Yield the returns and measures of each seed, and of random actions.

    `best_steps` are the steps of training at which the best policies were saved. They are None for the last policies.
    """
    task = run.config.task
    if task.evaluation_environment is not None:
        yield f"in {task.evaluation_environment} (training was in {task.environment}):"
    yield from _describe_returns(run, evaluation, best_steps)
    for team_index, (prefix, episodes) in enumerate(zip(_team_prefixes(task), random_episodes, strict=True)):
        if not episodes:
            continue
        returns = np.array([episode.return_ for episode in episodes])
        yield f"{prefix}random actions: {_format_returns(returns)}"
        if (difference := gain_over_random(evaluation.returns[:, :, team_index], returns)) is not None:
            yield f"{prefix}difference: {format_plus_minus(*difference)} (± is its standard error)"
    if (group := task.group) is not None and random_episodes[0]:
        groups = Counter(np.asarray(evaluation.measures[group]).ravel().tolist())
        random_groups = Counter(episode.measures[group] for episode in random_episodes[0])
        if any(groups[name] * random_groups.total() != count * groups.total() for name, count in random_groups.items()):
            yield f"random actions did not play the same groups ({group}) equally often; this is a part of the difference"
    for name, seed_values in evaluation.drop_group(task).measures.items():
        for seed, values in zip(run.seeds, seed_values, strict=True):
            yield f"seed {seed}: {name} {format_mean_std(values)}"
        if random_episodes[0]:
            values = np.array([episode.measures[name] for episode in random_episodes[0]])
            yield f"random actions: {name} {format_mean_std(values)}"


def _compare_actions(run: Run, sampled: Evaluation, likeliest: Evaluation) -> Iterator[str]:
    """Say which actions are better, if that is clear. Both evaluations play from the same initial states."""
    for team_index, prefix in enumerate(_team_prefixes(run.config.task)):
        difference = mean_with_error((likeliest.returns - sampled.returns)[:, :, team_index])
        if difference is not None and abs(difference[0]) > CLEAR_ERRORS * difference[1]:
            better = "better: use `--deterministic` here, and `load_policy(..., deterministic=True)` in Python"
            verdict = better if difference[0] > 0 else "worse: let the policy sample"
            yield f"{prefix}the most likely actions are {verdict} ({format_plus_minus(*difference)}; ± is the standard error)"


def _describe_returns(run: Run, evaluation: Evaluation, best_steps: Sequence[int] | None) -> Iterator[str]:
    """Yield the returns of each seed. `best_steps` is as in `describe_evaluation`."""
    has_many_agents = load_env_spec(run.config.task).n_agents > 1
    for team_index, prefix in enumerate(_team_prefixes(run.config.task)):
        for seed_index, seed in enumerate(run.seeds):
            line = f"{prefix}seed {seed}: {_format_returns(evaluation.returns[seed_index, :, team_index])}"
            if best_steps is not None:
                step = best_steps[seed_index]
                untrained = ", before its first update" if step <= run.config.settings.warmup else ""
                line += f" (the policy of step {step:,}{untrained})"
            if has_many_agents:
                sums = evaluation.summed_returns[seed_index, :, team_index]
                line += f"; summed over the agents {format_mean_std(sums)}"
            yield line


def _team_prefixes(task: TaskSpec) -> list[str]:
    """Return the beginnings of lines about each team. They are empty for a task without teams."""
    return [f"{role.name}, " if len(task.roles) > 1 else "" for role in task.roles]


def _format_returns(returns: Float[np.ndarray, " episodes"]) -> str:
    return f"return {format_mean_std(returns)} over {format_for_reader(len(returns), 'count episode')}"
