"""What it is worth to make each closed-form fit from three starts, and not only from the last fit.

    python benchmarks/starts.py RUN

RUN is a finished run of HalfCheetah-v4 that still has its replay. Its stored episodes get new scores, in the eight ways of
`basis.py`. They come one after the other: each return is predicted before the decoder is fitted to it. The results have, for each
number of starts and for every score: R^2 of the returns that were predicted so, over several ranges of episodes, mean over the
seeds; and in how many fits the evidence was smaller by more than 1 than with all three. One start is the last fit, two are that
and equal shares of the groups, three are these and the first group alone (`evidence.fit`).
"""

import sys
from collections.abc import Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from basis import SPEED, scores
from lare_rl.credit import evidence
from lare_rl.credit.basis import Basis, expand
from lare_rl.credit.closed_form import MAX_EVIDENCE_ROUNDS
from lare_rl.credit.evidence import SufficientStatistics
from lare_rl.credit.precisions import Posterior
from lare_rl.credit.score_type import ScoreType
from lare_rl.util.statistics import r_squared
from measure import write
from stored import stored_episodes

RANGES = ((10, 20), (20, 40), (40, 60))
EPISODES = 60
"""Later ones, if the run has them, are left out."""


def from_fewer(count: int, sums: SufficientStatistics, basis: Basis, start: Posterior) -> Posterior:
    """A fit from the first one or two of the three starts."""
    problem = evidence.regression(sums, ScoreType.SUM, basis.group_index)
    alpha, beta = evidence.starting_precisions(problem, start)
    candidates = jax.lax.map(
        lambda args: evidence.fixed_point(problem, args[0], args[1], MAX_EVIDENCE_ROUNDS), (alpha[:count], beta[:count])
    )
    return evidence.unscale(sums, problem, evidence.most_likely(candidates), fallback=start)


def from_three(sums: SufficientStatistics, basis: Basis, start: Posterior) -> Posterior:
    return evidence.fit(sums, ScoreType.SUM, basis.group_index, start, MAX_EVIDENCE_ROUNDS)


WAYS = {"one start": partial(from_fewer, 1), "two starts": partial(from_fewer, 2), "three starts": from_three}


@partial(jax.jit, static_argnames=("way", "basis"))
def learn(
    sums: SufficientStatistics, posterior: Posterior, mean: Array, total: Array, length: Array, way: str, basis: Basis
) -> tuple[SufficientStatistics, Posterior]:
    sums = evidence.add_episodes(sums, mean[None], total[None], length[None])
    return sums, WAYS[way](sums, basis, posterior)


def predicted(means: np.ndarray, returns: np.ndarray, length: np.ndarray, way: str, basis: Basis) -> list[Any]:
    """Of each episode: its prediction, and the log evidence of the fit that follows it."""
    state = (
        evidence.empty_statistics(basis.n_features),
        evidence.init_posterior(basis.group_index),
    )
    sums, posterior = jax.tree.map(lambda leaf: leaf.astype(float), state)
    predictions = []
    for mean, total, steps in zip(means, returns, length, strict=True):
        guess = float(steps * (mean @ posterior.weight + posterior.bias))
        sums, posterior = learn(sums, posterior, jnp.asarray(mean), jnp.asarray(total), jnp.asarray(steps), way, basis)
        predictions.append((guess, float(posterior.log_evidence)))
    return predictions


def episodes(directory: str) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray], np.ndarray, Basis]]:
    """For each seed: mean features of the episodes, the returns of each score, the lengths, and the basis."""
    for after, action, z, true_reward, ends in stored_episodes(directory):
        inputs = np.concatenate([z, after, action], axis=1)[: ends[-1]]
        basis = Basis(z.shape[1], inputs.shape[1] - z.shape[1], True)
        # The first ten episodes are random, and standardise all of them here; in training the statistics follow the policy.
        first = inputs[: ends[9]]
        features = np.asarray(expand(basis, jnp.asarray((inputs - first.mean(axis=0)) / first.std(axis=0))), np.float64)
        begins, length = np.append(0, ends[:-1]), np.diff(np.append(0, ends))
        means = np.add.reduceat(features, begins) / length[:, None]
        last = ends[-1]
        truths = scores(after[:last], action[:last], true_reward[:last], SPEED["HalfCheetah-v4"])
        yield (
            means,
            {name: np.add.reduceat(score_values, begins) for name, score_values in truths.items()},
            length,
            basis,
        )


def main(directory: str) -> None:
    table: dict[str, dict[str, Any]] = {}
    fits = 0
    seeds = [
        (means[:EPISODES], totals, length[:EPISODES], basis) for means, totals, length, basis in episodes(directory)
    ]
    with jax.enable_x64(True):
        for means, totals, length, basis in seeds:
            for score, returns in totals.items():
                returns = returns[:EPISODES]
                predictions_by_way = {way: np.array(predicted(means, returns, length, way, basis)) for way in WAYS}
                fewer = list(WAYS)[:2]
                row = table.setdefault(score, {way: [] for way in WAYS} | {"caught": dict.fromkeys(fewer, 0)})
                for way, predictions in predictions_by_way.items():
                    row[way].append([r_squared(returns[a:b], predictions[a:b, 0])[0] for a, b in RANGES])
                evidences = {way: predictions[10:, 1] for way, predictions in predictions_by_way.items()}
                for way in fewer:
                    row["caught"][way] += int(np.sum(evidences["three starts"] - evidences[way] > 1))
                fits += len(evidences["three starts"])
    print(f"R^2 of returns {', '.join(f'{a + 1} to {b}' for a, b in RANGES)}, mean over seeds")
    for score, row in table.items():
        text = "; ".join(f"{way}: {np.round(np.mean(row[way], axis=0), 3).tolist()}" for way in WAYS)
        print(f"{score:28} {text}; caught in {row['caught']} fits")
    write("starts", {"ranges": RANGES, "fits": fits, "scores": table})


if __name__ == "__main__":
    main(sys.argv[1])
