"""Reflection: a model sees how well its function explains the returns of some episodes, and tries to improve it.

The episodes are played for this purpose, or come from the replay of a finished run.
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lare_rl.credit.basis import Basis
from lare_rl.credit.explanation_text import MESSAGES, MIN_EXPLAINED_EPISODES, explanation_findings
from lare_rl.credit.factor_fit import N_FIRST, FactorAssessment, assess_factors
from lare_rl.credit.input_names import raw_feature_names
from lare_rl.envs.load import resolve_task
from lare_rl.envs.play import Episode, Policy, play_episodes
from lare_rl.errors import LareError, check_count
from lare_rl.latent.design import Conversation
from lare_rl.latent.function import LatentFunction, normalise_source
from lare_rl.llm import prompts
from lare_rl.llm.model import Model, ModelFunction, as_model
from lare_rl.llm.recorder import Recorder
from lare_rl.llm.recording import Exchange
from lare_rl.llm.reply import MalformedReplyError, parse_reply
from lare_rl.runs.directory import Run, as_run
from lare_rl.tasks.spec import MAX_LEVELS, TaskSpec, require_role, select_sides
from lare_rl.training.stored_episodes import stored_role_episodes
from lare_rl.util.findings import render

__all__ = ["FunctionAssessment", "assess_function", "reflect"]

N_EPISODES = 40
"""The default number of episodes to play."""
N_CORRELATED = 3
"""The number of other factors whose correlation with a factor is named."""


def reflect(
    function: LatentFunction,
    task: TaskSpec | str | Path,
    model: Model | ModelFunction,
    rounds: int = 1,
    *,
    episodes: Sequence[Episode] | Run | str | Path | None = None,
    policy: Policy | None = None,
    record: Path | None = None,
    on_message: Callable[[str], None] = lambda _: None,
) -> LatentFunction:
    """Show a model how well its function explains returns, and keep the function whose factors explain them best.

    This is not in the paper. A function is judged by R^2 of the returns of the same episodes, each predicted before it was
    seen (`credit/factor_fit.py`). If anything fails, the best function so far is returned.

    Args:
        function: a function from `lare_rl.design`, or written by hand.
        task: the task of the function: a name, a path, or a spec.
        model: the language model, as for `lare_rl.design`.
        episodes: whole episodes, or a run or its directory, whose stored episodes are used; by default, 40 are played.
        policy: plays the episodes of a single agent instead of random actions: a function from an observation (and the mask of
            available actions, if the environment has one) to an action.
        record: a file to record every exchange in; if the design was recorded, the same file.

    Raises:
        LareError: `rounds` is less than 1, `record` exists and does not hold the function's exchanges, or each team of the task has
            its own function.
    """
    role, model, rounds = require_role(resolve_task(task)), as_model(model), check_count("rounds", rounds)
    exchanges = [Exchange(**exchange) for exchange in function.exchanges]
    path = None if record is None else Path(record)
    recorder = Recorder(model, role.name, function.kind, path, exchanges)
    conversation = Conversation(role, function.kind, recorder, on_message)
    try:
        if episodes is None:
            episodes = play_episodes(role, N_EPISODES, policy)
        elif isinstance(episodes, Run | str | Path):
            episodes = stored_role_episodes(as_run(episodes), role)
        best, assessment = function, assess_function(function, role, episodes)
        if math.isnan(assessment.fit.r2):
            raise LareError(
                f"the returns of all episodes after the first {N_FIRST} are equal, and no function can predict them better than another"
            )
    except (LareError, KeyboardInterrupt) as error:
        on_message(f"no reflection: {str(error) or 'stopped'}")
        return function
    on_message(
        f"reflection: the factors of the first function predict unseen returns with R² = {assessment.fit.r2:.3f}"
    )
    for number in range(1, rounds + 1):
        try:
            evidence = "\n".join([*assessment.ranges, *assessment.sentences])
            request = prompts.reflect(role, _find_reply(best), evidence, function.kind)
            attempt = conversation.correct(request, recorder.ask("reflect", request))
            candidate = conversation.to_function(attempt)
            candidate_assessment = assess_function(candidate, role, episodes)
        except LareError as error:
            on_message(f"reflection {number}: {error}")
            continue
        except KeyboardInterrupt:
            on_message(f"reflection {number}: stopped")
            break
        is_better = candidate_assessment.fit.r2 > assessment.fit.r2
        on_message(
            f"reflection {number}: R² = {candidate_assessment.fit.r2:.3f}, {'kept' if is_better else 'not better'}"
        )
        if is_better:
            best, assessment = candidate, candidate_assessment
    return conversation.add_exchanges(best)


def _find_reply(function: LatentFunction) -> str:
    """Return the reply that a function was read from, or its source if no reply fits."""
    replies = [reply for exchange in function.exchanges for reply in exchange["replies"]]
    for reply in reversed(replies):
        try:
            if normalise_source(parse_reply(reply).functions) == function.source:
                return reply
        except MalformedReplyError:
            continue
    return function.source


class FunctionAssessment(NamedTuple):
    """What the returns of some episodes say about a function."""

    fit: FactorAssessment
    sentences: list[str]
    """Sentences for the user; empty if the returns are all the same."""
    ranges: list[str]
    """For each factor, a line on the range of its values and on its correlations."""


def assess_function(function: LatentFunction, role: TaskSpec, episodes: Sequence[Episode]) -> FunctionAssessment:
    """Assess a function by the returns of some episodes.

    Raises:
        LareError: there are too few episodes or too many groups, or the function failed on an episode.
    """
    if len(episodes) < MIN_EXPLAINED_EPISODES:
        raise LareError(f"{len(episodes)} episodes say too little of a function: {MIN_EXPLAINED_EPISODES} are needed")
    inputs = []
    for episode in episodes:
        observed = select_sides(role.scored_observation, episode.observation, episode.next_observation)
        factors = _compute_factors(function, role, episode)
        inputs.append(np.concatenate([factors, *observed, episode.env_action], axis=-1))
    names = function.factor_columns(role.scored_observation)
    basis = Basis(len(names), inputs[0].shape[-1] - len(names), extended=True)
    alive, returns = [episode.alive for episode in episodes], np.array([episode.return_ for episode in episodes])
    fit = assess_factors(inputs, alive, returns, basis, role.score, _levels(episodes))
    observation_names = select_sides(role.scored_observation, "observation", "next_observation")
    sizes = dict.fromkeys(observation_names, role.observation_size) | {"action": role.action_size}
    raw_names = raw_feature_names(role.observation, role.action, sizes) if basis.n_raw_used else []
    valid_factors = np.concatenate([rows[mask] for rows, mask in zip(inputs, alive, strict=True)])[:, : len(names)]
    findings = explanation_findings(fit.explanation, fit.score_type, names, raw_names)
    return FunctionAssessment(
        fit=fit,
        sentences=[render(finding, MESSAGES) for finding in findings],
        ranges=_describe_ranges(names, valid_factors),
    )


def _levels(episodes: Sequence[Episode]) -> Int[np.ndarray, " episodes"] | None:
    """Return the number of each episode's group; None if an episode has no group, or if there is only one group."""
    groups = [episode.group for episode in episodes]
    numbers = {group: i for i, group in enumerate(dict.fromkeys(groups))}
    if None in numbers or len(numbers) < 2:
        return None
    if len(numbers) > MAX_LEVELS:
        raise LareError(f"the episodes have more than {MAX_LEVELS} groups: merge some of them")
    return np.array([numbers[group] for group in groups])


def _compute_factors(
    function: LatentFunction, role: TaskSpec, episode: Episode
) -> Float[np.ndarray, "steps rows factors"]:
    """Compute the factors of an episode's steps. They are 0 for agents that have left."""
    mask = episode.alive
    z = function.step_factors(
        episode.observation[mask], episode.env_action[mask], episode.next_observation[mask], role.scored_observation
    )
    factors = np.zeros((*mask.shape, z.shape[1]), np.float32)
    factors[mask] = z
    return factors


def _describe_ranges(names: Sequence[str], factors: Float[np.ndarray, "rows factors"]) -> list[str]:
    """Return a line on each factor: the range of its values, and the factors with which it correlates most."""
    with np.errstate(all="ignore"):  # a factor that does not vary has no correlation
        correlation = np.atleast_2d(np.nan_to_num(np.corrcoef(factors, rowvar=False)))
    lines = []
    for i, name in enumerate(names):
        column, row = factors[:, i], correlation[i].tolist()
        order = sorted((j for j in range(len(names)) if j != i), key=lambda j, row=row: -round(abs(row[j]), 2))
        strongest = ", ".join(f"{row[j]:+.2f} with {names[j]}" for j in order[:N_CORRELATED])
        lines.append(
            f"- {name}: from {column.min():.4g} to {column.max():.4g}, mean {column.mean():.4g}, standard deviation "
            f"{column.std():.4g}; among the factors it correlates most {strongest or 'with none'}"
        )
    return lines
