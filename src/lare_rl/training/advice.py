"""Findings about a training that may not get anywhere."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from lare_rl.algorithms.ppo import PPOSettings
from lare_rl.config.effective import warmup_warning
from lare_rl.config.settings import ResolvedSettings
from lare_rl.config.train_config import TrainConfig
from lare_rl.credit.input_names import raw_feature_names
from lare_rl.data.replay import Replay
from lare_rl.new_task.draft import DEFAULT_LIMIT
from lare_rl.runs.directory import Run
from lare_rl.runs.metric_names import RETURN, RETURN_STD, was_updated
from lare_rl.tasks.spec import FILL_IN, TaskSpec, unwritten_texts
from lare_rl.util.findings import Finding, render
from lare_rl.util.statistics import FLOAT32_NOISE

__all__ = [
    "MESSAGES",
    "describe_untrained",
    "find_constant_returns",
    "find_equal_returns",
    "find_large_observations",
    "find_saturated_policies",
    "find_slow_evaluations",
    "find_untrained",
    "find_unwritten_texts",
]

MAX_RMS = 10.0
"""The largest root mean square of an observation's feature that needs no advice."""
N_PROBE_STATES = 1000
"""The most stored observations of an environment that are inspected."""
N_EQUAL_EVALUATIONS = 5
"""So many evaluations in a row with equal returns are reported."""
MIN_EQUAL_EPISODES = 10
"""Equal returns of all episodes are reported of a run with at least so many evaluated episodes."""
EQUAL_RTOL = 1e-3
"""Returns are equal if they differ by less than this fraction of their size."""
MAX_EVALUATION_SHARE, MIN_EVALUATION_S = 0.3, 5.0
"""An evaluation is slow if it takes a larger share of the time, and more seconds."""

MESSAGES = {
    "all steps random": "{reason}",
    "steps so far random": "all {step:,} steps so far were random, as the first {warmup:,} are ({algorithm}.warmup)",
    "too few episodes": "the policy has not been updated in {step:,} steps: {algorithm} needs {batch_size} finished episodes for "
    "its first update ({algorithm}.batch_size)",
    "large observations": (
        "Observations are large: the root mean square of {feature} is {rms:.3g} in the first steps, and {algorithm} does not "
        "normalise observations.{effect} Let the environment divide each entry by its "
        "range{alternative}."
    ),
    "actions at bounds": " Its actions may stay at their bounds.",
    "normalise": ", or set --{algorithm}.normalise-observations True",
    "use ppo": ", or use --algorithm ppo, which normalises observations",
    "saturated policies": (
        "{policies} chooses the same action in every state, with each entry at a bound. If the task needs more, the policy is "
        "stuck, and more steps seldom help: see docs/how-to/poor-policies.md."
    ),
    "one policy": "The policy",
    "policies of seeds": "The policy of {noun} {seeds}",
    "equal returns": "Every episode of every evaluation has the return {return_:number}. If training episodes have it too, nothing can be "
    "learned. Does the environment pay a score, and before its time limit (max_episode_steps)? Do bad episodes differ "
    "(docs/how-to/scores.md)?",
    "slow evaluations": "An evaluation takes {seconds:.0f} s, {share:.0%} of the time: --evaluation-episodes (now {n_episodes}) or "
    "--evaluate-every (now {every:,}) changes that.",
    "unwritten texts": "The task file still has the draft's {placeholder!r} ({keys}), so the report cannot name entries.{limit}",
    "guessed limit": " Its max_episode_steps = {limit} may be the draft's guess, too.",
    "provisional": "Provisional, from the few episodes so far; the end of the run has another explanation:",
    "constant returns": (
        "The last {n_evaluations} evaluations of every seed have the same return: what changed in the policy changes no "
        "episode. If this return is not good, the policy may be stuck: see docs/how-to/poor-policies.md."
    ),
}


def find_untrained(run: Run) -> Finding | None:
    """Find out why the policy of a run has not been updated, or never will be.

    Return None if it has been, and before the first evaluation of a run whose steps are not all random.
    """
    settings, lines = run.config.settings, run.metrics()
    if (reason := warmup_warning(settings)) is not None:
        return Finding("all steps random", {"reason": reason})
    if not lines or any(map(was_updated, lines)):
        return None
    step, algorithm = lines[-1]["step"], settings.algorithm
    if step <= settings.warmup:
        return Finding("steps so far random", {"step": step, "algorithm": algorithm, "warmup": settings.warmup})
    batch_size = getattr(settings.hyperparameters, "batch_size", 1)
    return Finding("too few episodes", {"step": step, "algorithm": algorithm, "batch_size": batch_size})


def describe_untrained(run: Run) -> str | None:
    """Return `find_untrained` as a sentence."""
    finding = find_untrained(run)
    return None if finding is None else render(finding, MESSAGES)


def find_unwritten_texts(task: TaskSpec) -> list[Finding]:
    """Find texts of a draft that the user has not written. The time limit may then be the draft's guess, too."""
    keys = tuple(dict.fromkeys(key for role in task.roles for key in unwritten_texts(role)))
    limit = Finding("guessed limit", {"limit": DEFAULT_LIMIT}) if task.max_episode_steps == DEFAULT_LIMIT else None
    return [Finding("unwritten texts", {"placeholder": FILL_IN, "keys": keys, "limit": limit})] if keys else []


def find_large_observations(run: Run, replay: Replay, config: TrainConfig) -> list[Finding]:
    """Find the largest feature of the observations, if it is too large for an algorithm that does not normalise observations.

    A large feature may drive a policy that ends in a tanh to a bound of the actions before its first update. Its gradient is
    then 0.
    """
    algorithm, hyperparameters = run.config.settings.algorithm, run.config.settings.hyperparameters
    can_normalise = isinstance(hyperparameters, PPOSettings)
    if (can_normalise and hyperparameters.normalise_observations) or "observation" not in replay.columns:
        return []
    n_rows = min(N_PROBE_STATES, int(np.min(np.asarray(replay.next_row)[0])))
    observation = np.asarray(replay.columns["observation"][0, :, :n_rows], np.float64)
    rms = np.sqrt(np.mean(np.square(observation.reshape(-1, config.env.observation_size)), axis=0))
    largest = int(np.argmax(rms))
    if not rms[largest] > MAX_RMS:
        return []
    alternative = Finding("use ppo") if config.env.n_agents == 1 else None
    if can_normalise:
        alternative = Finding("normalise", {"algorithm": algorithm})
    sizes = {"observation": config.env.observation_size}
    task = run.config.task
    # With the credit scope "state", the text describes the state. Each team has a text of its own.
    text = "" if config.team_level or task.teams else task.observation
    feature = raw_feature_names(text, "", sizes)[largest]
    values = {"feature": feature, "rms": float(rms[largest]), "algorithm": algorithm, "alternative": alternative}
    values["effect"] = None if config.env.discrete else Finding("actions at bounds")
    return [Finding("large observations", values)]


def find_saturated_policies(saturations: Sequence[float], seeds: Sequence[int]) -> list[Finding]:
    """Find the seeds whose policy chooses the same bounds in all states, by the saturation of each seed's policy."""
    stuck = tuple(seed for seed, fraction in zip(seeds, saturations, strict=True) if fraction == 1)
    if not stuck:
        return []
    values = {"noun": "seed" if len(stuck) == 1 else "seeds", "seeds": stuck}
    policies = Finding("one policy") if len(seeds) == 1 else Finding("policies of seeds", values)
    return [Finding("saturated policies", {"policies": policies})]


def find_constant_returns(returns: Sequence[Float[np.ndarray, " seeds"]]) -> list[Finding]:
    """Find out whether the last evaluations of every seed have equal returns, and did not have them one evaluation before.

    `returns` has all evaluations since the policy was first updated.
    """
    if not _are_equal(returns[-N_EQUAL_EVALUATIONS:]) or _are_equal(returns[-N_EQUAL_EVALUATIONS - 1 : -1]):
        return []
    return [Finding("constant returns", {"n_evaluations": N_EQUAL_EVALUATIONS})]


def find_slow_evaluations(settings: ResolvedSettings, evaluation_s: float, interval_s: float) -> list[Finding]:
    """Find out whether an evaluation takes much of the time. `interval_s` is the time between the ends of two evaluations."""
    share = evaluation_s / interval_s
    if share <= MAX_EVALUATION_SHARE or evaluation_s <= MIN_EVALUATION_S:
        return []
    values = {"n_episodes": settings.evaluation_episodes, "every": settings.evaluate_every}
    return [Finding("slow evaluations", {"seconds": evaluation_s, "share": share, **values})]


def find_equal_returns(run: Run) -> list[Finding]:
    """Find out whether all evaluated episodes of a run have the same return, as if the score were never paid."""
    lines = run.metrics()
    returns, stds = np.array([(line[RETURN], line[RETURN_STD]) for line in lines], float).reshape(-1, 2).T
    if len(lines) * run.config.settings.evaluation_episodes < MIN_EQUAL_EPISODES:
        return []
    limit = FLOAT32_NOISE * np.abs(returns).max()
    is_equal = np.ptp(returns) <= limit and stds.max() <= limit
    return [Finding("equal returns", {"return_": float(returns[0])})] if is_equal else []


def _are_equal(returns: Sequence[Float[np.ndarray, " seeds"]]) -> bool:
    if len(returns) < N_EQUAL_EVALUATIONS:
        return False
    per_seed = np.array(returns)
    return bool(np.all(np.ptp(per_seed, axis=0) <= EQUAL_RTOL * np.abs(per_seed).max(axis=0)))
