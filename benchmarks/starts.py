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
from lare_rl.credit.closed_form import ROUNDS
from lare_rl.credit.evidence import Posterior, Sums
from lare_rl.credit.factor_fit import r2_and_error
from measure import write
from stored import of_each_seed

RANGES = ((10, 20), (20, 40), (40, 60))
EPISODES = 60
"""Later ones, if the run has them, are left out."""


def from_fewer(count: int, sums: Sums, basis: Basis, start: Posterior) -> Posterior:
    """A fit from the first one or two of the three starts."""
    given = evidence.problem(sums, 0, basis.group)
    alpha, beta = evidence.starts(given, start)
    first = alpha[:count], beta[:count]
    of_each = jax.lax.map(lambda one: evidence.fixed_point(given, one[0], one[1], ROUNDS), first)
    return evidence.in_return_units(sums, 0, given, evidence.most_likely(of_each), otherwise=start)


def from_three(sums: Sums, basis: Basis, start: Posterior) -> Posterior:
    return evidence.fit(sums, 0, basis.group, start, ROUNDS)


WAYS = {"one start": partial(from_fewer, 1), "two starts": partial(from_fewer, 2), "three starts": from_three}


@partial(jax.jit, static_argnames=("way", "basis"))
def learn(
    sums: Sums, known: Posterior, mean: Array, total: Array, length: Array, way: str, basis: Basis
) -> tuple[Sums, Posterior]:
    sums = evidence.add_episodes(sums, mean[None], total[None], length[None])
    return sums, WAYS[way](sums, basis, known)


def predicted(means: np.ndarray, returns: np.ndarray, length: np.ndarray, way: str, basis: Basis) -> list[Any]:
    """Of each episode: its prediction, and the log evidence of the fit that follows it."""
    state = evidence.no_sums(basis.size), evidence.unknown(basis.size, len(basis.sizes))
    sums, known = jax.tree.map(lambda leaf: leaf.astype(float), state)
    found = []
    for mean, total, steps in zip(means, returns, length, strict=True):
        guess = float(steps * (mean @ known.weight + known.bias))
        sums, known = learn(sums, known, jnp.asarray(mean), jnp.asarray(total), jnp.asarray(steps), way, basis)
        found.append((guess, float(known.log_evidence)))
    return found


def episodes(directory: str) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray], np.ndarray, Basis]]:
    """For each seed: mean features of the episodes, the returns of each score, the lengths, and the basis."""
    for after, action, z, paid, ends in of_each_seed(directory):
        inputs = np.concatenate([z, after, action], axis=1)[: ends[-1]]
        basis = Basis(z.shape[1], inputs.shape[1] - z.shape[1], True)
        # The first ten episodes are random, and standardise all of them here; in training the statistics follow the policy.
        first = inputs[: ends[9]]
        features = np.asarray(expand(basis, jnp.asarray((inputs - first.mean(axis=0)) / first.std(axis=0))), np.float64)
        begins, length = np.append(0, ends[:-1]), np.diff(np.append(0, ends))
        means = np.add.reduceat(features, begins) / length[:, None]
        last = ends[-1]
        truths = scores(after[:last], action[:last], paid[:last], SPEED["HalfCheetah-v4"])
        yield means, {name: np.add.reduceat(one, begins) for name, one in truths.items()}, length, basis


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
                of_way = {way: np.array(predicted(means, returns, length, way, basis)) for way in WAYS}
                fewer = list(WAYS)[:2]
                row = table.setdefault(score, {way: [] for way in WAYS} | {"caught": dict.fromkeys(fewer, 0)})
                for way, found in of_way.items():
                    row[way].append([r2_and_error(returns[a:b], found[a:b, 0])[0] for a, b in RANGES])
                evidences = {way: found[10:, 1] for way, found in of_way.items()}
                for way in fewer:
                    row["caught"][way] += int(np.sum(evidences["three starts"] - evidences[way] > 1))
                fits += len(evidences["three starts"])
    print(f"R^2 of returns {', '.join(f'{a + 1} to {b}' for a, b in RANGES)}, mean over seeds")
    for score, row in table.items():
        shown = "; ".join(f"{way}: {np.round(np.mean(row[way], axis=0), 3).tolist()}" for way in WAYS)
        print(f"{score:28} {shown}; caught in {row['caught']} fits")
    write("starts", {"ranges": RANGES, "fits": fits, "scores": table})


if __name__ == "__main__":
    main(sys.argv[1])
