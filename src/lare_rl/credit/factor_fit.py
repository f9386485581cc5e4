"""How well factors predict returns that a fit has not seen, and the explanation of all returns by the factors.

    R^2 = 1 - sum_k (R_k - R_hat_k)^2 / sum_k (R_k - mean R)^2

R_hat_k is predicted by a closed-form fit, on the factors alone, to episodes before k (the prequential principle: Dawid, Journal
of the Royal Statistical Society A 147, 1984). The fit is repeated whenever the number of episodes has grown by a twentieth. No
return is seen before it is predicted, but the factors are standardised over all episodes. R^2 thus allows comparing two functions
with different numbers of factors.
"""

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lare_rl.credit import evidence
from lare_rl.credit.basis import Basis
from lare_rl.credit.closed_form import GROWTH_OF_FIT, ROUNDS, LinearDecoder
from lare_rl.credit.decomposition import AVERAGE, SUM
from lare_rl.credit.evidence import Posterior, Sums
from lare_rl.credit.explanation import Explanation, Steps, add_steps, explain, no_steps
from lare_rl.credit.returns import BETTER, FormFound
from lare_rl.util.float64 import float64

FIRST = 10
"""Number of episodes before the first prediction."""


class Judgement(NamedTuple):
    """The judgement of factors by one team's returns."""

    r2: float
    """NaN if all returns are equal or there are too few."""
    r2_error: float
    """The standard error of `r2` over the episodes; NaN like it."""
    r2_of_lengths: float | None
    """R^2 of predictions from the lengths of the episodes alone; None if they do not differ, or the score is an average."""
    form: FormFound | None
    """None if it is given or makes no difference, because all episodes have one length."""
    explanation: Explanation


def judge(
    rows: Sequence[Float[np.ndarray, "_ agents inputs"]],
    alive: Sequence[Bool[np.ndarray, "_ agents"]],
    returns: Float[np.ndarray, " episodes"],
    basis: Basis,
    score: str | None = None,
) -> Judgement:
    """Judge the factors of some episodes, which must be in the order of play.

    Args:
        rows: for each episode, factors and raw entries of each step and agent.
        alive: for each episode, which agents acted at each step.
        returns: R of each episode.
        basis: the features that are computed from the rows.
        score: `sum` or `average`, if the form of the score is known.
    """
    length = np.array([len(steps) for steps in rows])
    with float64():
        means, steps = features_of(rows, alive, basis)
        forms = (SUM, AVERAGE) if len(set(length)) > 1 else (SUM,)
        forms = {"sum": (SUM,), "average": (AVERAGE,)}.get(score or "", forms)
        told = {form: predictions(means[:, basis.of_factors], returns, length, basis, form) for form in forms}
        errors = {form: float(np.sum((returns[FIRST:] - one) ** 2)) for form, one in told.items()}
        form = AVERAGE if errors.get(AVERAGE, np.inf) < BETTER * errors.get(SUM, np.inf) else SUM
        if form == SUM and len(set(length)) > 1:
            no_factors = np.zeros_like(means)[:, basis.of_factors]
            lengths = predictions(no_factors, returns, length, basis, SUM)
        else:
            lengths = None
        explanation = jax.tree.map(np.asarray, explained(means, returns, length, steps, form, basis=basis))
    decided = min(errors.values()) < BETTER * max(errors.values())
    return Judgement(
        *r2_and_error(returns[FIRST:], told[form]),
        None if lengths is None else r2_and_error(returns[FIRST:], lengths)[0],
        FormFound(form == AVERAGE, decided) if len(forms) > 1 else None,
        explanation,
    )


def r2_and_error(
    returns: Float[np.ndarray, " episodes"], predicted: Float[np.ndarray, " episodes"]
) -> tuple[float, float]:
    """R^2 of predicted returns, and its standard error; NaN if the returns are equal or fewer than two.

        e_k = (R_k - R_hat_k)^2,   d_k = (R_k - mean R)^2,   R^2 = 1 - sum e / sum d
        error^2 = n / (n - 1) * sum_k (e_k - (1 - R^2) d_k)^2 / (sum d)^2

    1 - R^2 is a ratio of two means, and the error is that of a linearised ratio (Cochran, Sampling Techniques, 3rd edition, 1977,
    section 2.11).
    """
    if len(returns) < 2:
        return np.nan, np.nan
    errors, deviations = (returns - predicted) ** 2, (returns - returns.mean()) ** 2
    if not deviations.sum() > 1e-10 * np.sum(returns**2):
        return np.nan, np.nan
    ratio = errors.sum() / deviations.sum()
    variance = np.sum((errors - ratio * deviations) ** 2) / deviations.sum() ** 2
    return float(1 - ratio), float(np.sqrt(len(returns) / (len(returns) - 1) * variance))


def features_of(
    rows: Sequence[Float[np.ndarray, "_ agents inputs"]], alive: Sequence[Bool[np.ndarray, "_ agents"]], basis: Basis
) -> tuple[Float[np.ndarray, "episodes features"], Steps]:
    """The mean features of each episode, with inputs standardised over all steps, and the sums over all steps."""
    every = np.concatenate([steps[there] for steps, there in zip(rows, alive, strict=True)]).astype(np.float64)
    mean, spread = every.mean(axis=0), every.std(axis=0)
    spread = np.where(spread > 1e-6 * np.abs(mean), spread, 0)  # a constant may vary by this much in float32
    known = (jnp.asarray(one, jnp.float32) for one in (mean, spread, np.zeros(basis.size), 0))
    decoder, longest = LinearDecoder(basis, *known), max(map(len, rows))
    found, sums = [], no_steps(basis)
    for steps, there in zip(rows, alive, strict=True):
        share = there / np.maximum(there.sum(axis=1, keepdims=True), 1) / len(steps)
        padding = (0, longest - len(steps)), (0, 0)  # to one length, so that `of_one` is compiled once
        padded = np.pad(steps, (*padding, (0, 0))).astype(np.float32)
        mean, sums = of_one(decoder, sums, padded, np.pad(share, padding))
        found.append(mean)
    return np.stack(found), sums


@jax.jit
def of_one(
    decoder: LinearDecoder, sums: Steps, steps: Float[Array, "steps agents inputs"], share: Float[Array, "steps agents"]
) -> tuple[Float[Array, " features"], Steps]:
    """The weighted sum of the features of an episode's steps, and the sums over the steps of all episodes so far."""
    features = decoder.features(steps).astype(float)
    return jnp.einsum("taf,ta->f", features, share), add_steps(sums, features, share > 0, decoder.basis)


def predictions(
    means: Float[np.ndarray, "episodes features"],
    returns: Float[np.ndarray, " episodes"],
    length: Int[np.ndarray, " episodes"],
    basis: Basis,
    form: int,
) -> Float[np.ndarray, " later_episodes"]:
    """R_hat of all episodes but the first `FIRST`, each by a fit to episodes before it."""
    group = basis.group[basis.of_factors]
    sums, known = evidence.no_sums(len(group)), evidence.unknown(len(group), int(group.max()) + 1)
    sums, known = jax.tree.map(lambda zero: zero.astype(float), (sums, known))
    blocks = list(growing(len(returns)))
    places = max((end - start for start, end in blocks), default=1)
    told = [np.zeros(0)]
    for (start, end), (after, until) in pairwise(blocks):
        new = (means[start:end], returns[start:end], length[start:end])
        padded = (np.pad(part, ((0, places - len(part)), *[(0, 0)] * (part.ndim - 1))) for part in new)
        sums, known = learn(sums, known, *padded, form=form, basis=basis)
        later = slice(after, until)
        parts = 1 if form == AVERAGE else length[later]
        told.append(parts * (means[later] @ np.asarray(known.weight) + float(known.bias)))
    return np.concatenate(told)


@partial(jax.jit, static_argnames="basis")
def learn(
    sums: Sums,
    known: Posterior,
    means: Float[Array, "episodes features"],
    returns: Float[Array, " episodes"],
    length: Int[Array, " episodes"],
    form: Int[Array, ""] | int,
    basis: Basis,
) -> tuple[Sums, Posterior]:
    """Add episodes to the sums, and fit to all of them."""
    sums = evidence.add_episodes(sums, means, returns, length)
    return sums, evidence.fit(sums, form, basis.group[basis.of_factors], known, ROUNDS)


@partial(jax.jit, static_argnames="basis")
def explained(
    means: Float[Array, "episodes features"],
    returns: Float[Array, " episodes"],
    length: Int[Array, " episodes"],
    steps: Steps,
    form: Int[Array, ""] | int,
    basis: Basis,
) -> Explanation:
    """`explain`, by a fit to these episodes."""
    return explain(
        evidence.add_episodes(evidence.no_sums(basis.size), means, returns, length), steps, form, basis=basis
    )


def growing(count: int) -> Iterator[tuple[int, int]]:
    """Start and end of each block of episodes that are added together: the first ones, then about a twentieth more each time."""
    start, end = 0, min(FIRST, count)
    while start < count:
        yield start, end
        start, end = end, min(count, max(end + 1, int(GROWTH_OF_FIT * end)))
