"""Sentences that explain the returns that a `CreditAssigner` stores, whatever its decoder is."""

from collections.abc import Hashable, Iterable
from dataclasses import replace

import jax
import numpy as np

from lare_rl.assigner import compiled_functions as compiled
from lare_rl.assigner.batches import whole_episodes
from lare_rl.assigner.compiled_functions import on_cpu
from lare_rl.assigner.decoder_learner import DecoderLearner
from lare_rl.credit import decoder_state
from lare_rl.credit.explanation import Explanation
from lare_rl.credit.explanation_text import MESSAGES, returns_findings
from lare_rl.util.findings import render
from lare_rl.util.float64 import float64

__all__ = ["describe_returns", "explain"]


def describe_returns(learner: DecoderLearner, group_names: Iterable[Hashable]) -> list[str]:
    """Return the explanation in sentences: none for too few episodes, and for a method without a decoder."""
    learner.learn_returns()
    explanation, config = explain(learner), learner.config
    if explanation is None:
        return []
    factor_names = [] if config.phi is None else config.phi.factor_columns(config.scored_observation)
    findings = returns_findings(
        explanation,
        learner.decoder,
        config.spec,
        factor_names,
        config.raw_feature_names,
        group_names,
        only_at_end=config.payments.only_at_end,
    )
    return [render(finding, MESSAGES) for finding in findings]


def explain(learner: DecoderLearner) -> Explanation | None:
    """Explain the stored returns by the inputs. Return None for a method without a decoder, and without episodes."""
    decoder, store, spec = learner.decoder, learner.store, learner.config.spec
    # Shares are of factors and raw features alone.
    basis = replace(spec.basis, extended=True, n_tracked=0, n_levels=0, prefixes=False, start_value=True)
    if spec.method.fit is None or not store.episodes or not basis.n_features:
        return None
    with on_cpu(), float64():
        state = compiled.init_explanation(decoder.statistics, basis=basis)
        for batch in whole_episodes(store, spec, list(store.episodes.values())):
            state = compiled.add_to_explanation(state, batch)
        score_type, start_value = decoder.is_average.astype(int), decoder_state.explained_start_value(decoder)
        return jax.tree.map(np.asarray, compiled.explain(state, score_type, start_value))
