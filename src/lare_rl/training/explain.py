"""Explain a run's stored returns by its factors, whatever decoder the run trains with."""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from lare_rl.config.train_config import TrainConfig
from lare_rl.credit.decoder_state import CreditBatch, explained_start_value, valid_rows
from lare_rl.credit.explanation import Explanation, add_to_explanation, explain, init_explanation
from lare_rl.credit.explanation_text import LEGEND_CODES, MESSAGES, MIN_EXPLAINED_EPISODES, returns_findings
from lare_rl.credit.methods import FACTORS_ALONE, METHODS, Method
from lare_rl.data.replay import Index, Replay, segments_as_episodes
from lare_rl.nn.normalise import RunningMeanStd, empty_mean_std, update_mean_std
from lare_rl.runs.directory import Run
from lare_rl.training.compile_cache import cache_by_value
from lare_rl.training.episodes import fold_episodes
from lare_rl.training.learner import Learner
from lare_rl.training.saved_state import load_learner
from lare_rl.training.seed_axis import first_device_seeds, select_seed
from lare_rl.util.findings import Finding, render
from lare_rl.util.float64 import float64

__all__ = [
    "compile_explanation",
    "describe_returns",
    "explain_run",
    "explain_stored_returns",
    "explanation_source",
    "find_explanations",
]


def explain_run(run: Run) -> list[str]:
    """Return the explanation of the returns in a run's last checkpoint, in sentences."""
    config, learner, _, _ = load_learner(run)
    return describe_returns(run, learner, config)


def find_explanations(run: Run) -> list[list[Finding]]:
    """Return the findings about the returns in a run's last checkpoint, for each team."""
    config, learner, _, _ = load_learner(run)
    return _find_explanations(run, learner, config)


def explanation_source(run: Run) -> str:
    """Return which seed an explanation is of, and by which fit. Empty for the only seed and its decoder."""
    method = METHODS.find(run.config.settings.method)
    remarks = [f"of seed {run.seeds[0]} alone"] if len(run.seeds) > 1 else []
    if method is not _explaining_method(method):
        remarks.append(f"by a closed-form fit to the stored returns, which is not the decoder of {method.name}")
    text = ", ".join(remarks)
    return text[:1].upper() + text[1:]


def describe_returns(run: Run, learner: Learner, config: TrainConfig, legend: bool = True) -> list[str]:
    """Return the explanation of the returns of a run's first seed, in sentences; with or without how to read it."""
    lines = [
        f"{f'{team.name}: ' if len(run.config.task.roles) > 1 else ''}{render(finding, MESSAGES)}"
        for team, findings in zip(config.env.teams, _find_explanations(run, learner, config), strict=False)
        for finding in findings
        if legend or finding.code not in LEGEND_CODES
    ]
    source = explanation_source(run)
    return [f"{source}:", *lines] if lines and source else lines


def _find_explanations(run: Run, learner: Learner, config: TrainConfig) -> list[list[Finding]]:
    findings, fitted_specs = [], _explanation_config(config).credit_specs
    for i, explanation in enumerate(explain_stored_returns(learner, config)):
        role, spec = run.config.task.roles[i], config.credit_specs[i]
        factor_names = run.functions[i].factor_columns(run.scored_observation) if run.functions else []
        # The decoders of several teams read the actions of all, and a team's text describes only its own.
        has_names = not config.team_level or len(config.env.teams) == 1
        raw_names = fitted_specs[i].raw_feature_names(role.observation, role.action) if has_names else []
        decoder = select_seed(first_device_seeds(learner.decoders[i]))
        names = factor_names, raw_names, range(spec.n_levels)
        only_at_end = run.config.task.payment_rule.only_at_end
        findings.append(returns_findings(explanation, decoder, spec, *names, only_at_end=only_at_end))
    return findings


def explain_stored_returns(learner: Learner, config: TrainConfig) -> list[Explanation]:
    """Explain the returns of the first seed's stored episodes, for each team.

    The list is empty for a method that fits nothing to returns, and for fewer than `MIN_EXPLAINED_EPISODES` episodes.
    """
    replay = segments_as_episodes(learner.replay)
    n_stored = np.sum(np.asarray(replay.current_episode)[0] - np.asarray(replay.oldest)[0])
    if not _can_explain(config) or n_stored < MIN_EXPLAINED_EPISODES:
        return []
    with float64():
        explanations = _compile(_explanation_config(config))(*first_device_seeds((replay, _score_facts(learner))))
        return jax.tree.map(np.asarray, explanations)


def compile_explanation(learner: Learner, config: TrainConfig) -> None:
    """Compile `explain_stored_returns` for a learner of these shapes, on one device, also in another thread."""
    if not _can_explain(config):
        return
    with jax.enable_x64(True):
        inputs = segments_as_episodes(learner.replay), jax.eval_shape(_score_facts, learner)
        shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), inputs)
        _compile(_explanation_config(config)).lower(*shapes).compile()


def _can_explain(config: TrainConfig) -> bool:
    """Return whether the run's method is fitted to returns, and the explanation has features."""
    has_features = all(spec.basis.n_features for spec in _explanation_config(config).credit_specs)
    return config.method.fit is not None and has_features


def _explaining_method(method: Method) -> Method:
    return METHODS["lare-bayes" if method.needs_phi else "bayes"]


def _explanation_config(config: TrainConfig) -> TrainConfig:
    """Return the run's configuration with a closed-form method, whose inputs are in the columns of the run's replay."""
    observed = "state" if config.team_level else "observation"
    has_raw_features = {observed, "action"} <= set(config.columns)
    if has_raw_features:
        method = _explaining_method(config.method)
    elif config.method.needs_phi:
        method = FACTORS_ALONE
    else:
        method = replace(METHODS["bayes"], inputs=config.method.inputs)
    return replace(config, method=method)


@cache_by_value
def _compile(config: TrainConfig) -> Any:
    return jax.jit(partial(_explain_first_seed, config=config))


_ScoreFacts = tuple[tuple[Bool[Array, " seeds"], Float[Array, " seeds"]], ...]
"""For each team, whether its score is an average, and the start value of a sum."""


def _score_facts(learner: Learner) -> _ScoreFacts:
    return tuple((decoder.is_average, jax.vmap(explained_start_value)(decoder)) for decoder in learner.decoders)


def _explain_first_seed(replay: Replay, score_facts: _ScoreFacts, config: TrainConfig) -> list[Explanation]:
    buffer, score_facts = select_seed((replay, score_facts))
    bases = [replace(spec.basis, n_levels=0) for spec in config.credit_specs]
    empty = tuple(empty_mean_std(basis.n_inputs) for basis in bases)
    # The inputs are standardised first, because the run's decoder may have other inputs, or statistics of earlier steps.
    statistics = fold_episodes(empty, buffer, buffer.oldest, _observe, config)
    states = tuple(init_explanation(team, basis) for team, basis in zip(statistics, bases, strict=True))
    states = fold_episodes(
        states, buffer, buffer.oldest, lambda state, batch, _: add_to_explanation(state, batch), config
    )
    return [
        explain(state, is_average.astype(int), start)
        for state, (is_average, start) in zip(states, score_facts, strict=True)
    ]


def _observe(statistics: RunningMeanStd, episodes: CreditBatch, first: Index) -> RunningMeanStd:
    return update_mean_std(statistics, episodes.inputs, valid_rows(episodes))
