"""Propositions 1 and 2 of the paper on small tabular problems: whether the bound holds, and how the regret grows with the table."""

import itertools
from collections.abc import Mapping

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lare_rl.report import figures
from lare_rl.util.statistics import Band, format_plus_minus
from paper import theory
from paper.exhibits import Budget
from paper.pages import Page, items, table
from paper.theory import History, Table

TITLE = "Regret with a latent table, and with a raw one"
CORES, ACTIONS, HORIZON, DELTA = 3, 2, 5, 0.1
REDUNDANT = (1, 2, 4, 8, 16)
"""Redundant forms of each relevant state. With one form, raw and latent table are the same; the latent table never changes."""
PICTURE = "theory-regret.svg"


def make_page(budget: Budget, command: str) -> Page:
    """Play OFUL on random problems, with tables of more and more redundant entries."""
    episodes, runs = budget.tabular.episodes, budget.tabular.runs
    histories = {redundant: played(redundant, episodes, runs) for redundant in REDUNDANT}
    latent = float(np.mean(last(histories[1])))
    rows = [row(redundant, history, latent) for redundant, history in histories.items()]
    sections = [
        f"# {TITLE}",
        f"Propositions 1 and 2 of the paper (section Analysis, appendix B), by `{command}`: OFUL with an episode's sum of "
        f"rewards for feedback, on {runs} random problems of {CORES} states that matter and {ACTIONS} actions, "
        f"horizon {HORIZON}, {episodes:,} episodes, lambda = {HORIZON}, delta = {DELTA}. Each state appears in one of several "
        "redundant forms, which is random at every step. The raw table has an entry for each form and action; phi leaves "
        "the form out, so the latent table is always that of the first row.",
        f"![regret]({PICTURE})",
        table(
            [
                "redundant forms",
                "entries",
                "regret",
                "to the latent one",
                "radius l_K",
                "largest error, in radii",
                f"runs in which the bound always holds (promised: {1 - DELTA / 10:.0%})",
            ],
            rows,
        ),
        "Mean ± standard deviation over the problems, after the last episode.",
        "## What the paper says, and what came out",
        items(
            (
                "Proposition 1, |r - r_hat_k| <= l_k at all k with probability 1 - delta/10: see above. The problems are the same "
                "for every table.",
                "Proposition 2, the regret with |D| entries is bounded lower than with |S||A|: the raw table's regret is "
                f"{np.mean(last(histories[REDUNDANT[-1]])) / latent:.1f} times the latent one's with {REDUNDANT[-1]} forms, and "
                f"{growth(histories)}. The latent one's does not change with the forms, because phi leaves them out.",
            )
        ),
        "## What differs from the paper",
        items(
            (
                "The paper has proofs, and no experiment. Problems, sizes and policies (all deterministic ones that depend on the "
                "relevant state only, so that OFUL's maximum is exact) are ours.",
            )
        ),
    ]
    lines = {label(redundant): band(history) for redundant, history in histories.items()}
    return Page(
        "theory", "\n\n".join(sections), {PICTURE: figures.draw_bands(lines, "episodes", "regret", x_is_steps=True)}
    )


def played(redundant: int, episodes: int, runs: int) -> History:
    """One problem for each run, the same for every table."""

    def simulate(key: PRNGKeyArray) -> History:
        problem, luck = jax.random.split(key)
        return theory.oful(luck, theory.random_mdp(problem, CORES, ACTIONS), redundant, HORIZON, episodes, DELTA)

    return jax.vmap(simulate)(jax.random.split(jax.random.key(0), runs))


def last(history: History) -> Float[np.ndarray, " runs"]:
    """Regret after the last episode."""
    return np.asarray(history.regret)[:, -1]


def row(redundant: int, history: History, latent: float) -> list[str]:
    mean, deviation = float(np.mean(last(history))), float(np.std(last(history), ddof=1))
    return [
        label(redundant),
        str(Table(CORES, redundant, ACTIONS).size),
        format_plus_minus(mean, deviation),
        f"{mean / latent:.2f}",
        f"{float(history.radius[0, -1]):.1f}",
        f"{float(np.max(np.asarray(history.error / history.radius))):.2f}",
        bound_holds(history),
    ]


def bound_holds(history: History) -> str:
    """In how many runs the bound held at every episode."""
    always = np.asarray(theory.bound_holds(history))
    return f"{always.sum()} of {always.size}"


def growth(histories: Mapping[int, History]) -> str:
    means = [float(np.mean(last(history))) for history in histories.values()]
    grows = all(more > less for less, more in itertools.pairwise(means))
    return "it grows with every doubling" if grows else "it does not grow with every doubling at this budget"


def label(redundant: int) -> str:
    return "1 (latent)" if redundant == 1 else f"{redundant}"


def band(history: History) -> Band:
    """Episodes, mean regret, and one standard deviation on both sides."""
    regret = np.asarray(history.regret)
    stride = max(1, regret.shape[1] // 200)
    thinned = regret[:, ::stride]
    mean, deviation = thinned.mean(axis=0), thinned.std(axis=0, ddof=1)
    return Band(np.arange(1, regret.shape[1] + 1, stride, dtype=float), mean, mean - deviation, mean + deviation)
