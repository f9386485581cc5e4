"""In words: how well returns can be told from the factors, which factors matter, and what may be missing."""

import re

import numpy as np

from lare.credit.explanation import Explanation

FEWEST = 20
"""Episodes, below which nothing is said."""
NEXT_TO_NOTHING = 0.1
"""Of the variation of the returns."""
NOTICEABLE = 0.05
"""Of the variation: a share that is worth a word."""
STRIKING = 0.3
"""A correlation with what the factors leave."""
FORMS = ("sum", "average")
"""Of a score, by number."""


def entry_names(observation: str, action: str, entries: int, action_size: int) -> list[str]:
    """What a task's texts call the entries of [s', a]: `7: angle of the foot` names entry 7.

    Args:
        observation: the text of the observation.
        action: that of the action.
        entries: all of them; none has fewer than those of the action, but 0.
        action_size: how many of them, at the end, are the action's.
    """

    def named(text: str, count: int, kind: str) -> list[str]:
        lines = dict(re.findall(r"^[\s\-*\[]*(\d+)\]?\s*[:.)]\s*(.+)$", text, flags=re.MULTILINE))
        return [
            f"entry {i} of the {kind}" + (f" ({lines[str(i)].strip()})" if str(i) in lines else "")
            for i in range(count)
        ]

    shown = max(0, entries - action_size)
    return named(observation, shown, "observation") + named(action, entries - shown, "action")


def is_bent(found: Explanation, factor: int) -> bool:
    """Whether the score goes with a factor, but is not higher wherever the factor is larger: a target value, say."""
    return bool(found.share[factor] > NOTICEABLE and abs(found.weight[factor]) < 2 * found.deviation[factor])


def words(found: Explanation, form: str | None, factors: list[str], entries: list[str]) -> list[str]:
    """What is to be said, a sentence each.

    Args:
        found: of one team's score.
        form: `sum` or `average`, where it was found out; None where it makes no difference.
        factors: names of the factors; empty for a method without.
        entries: names of the raw entries.
    """
    count = int(found.episodes)
    if count < FEWEST or not np.isfinite(found.by_all):
        return []
    said = []
    if form is not None:
        said.append(
            {
                "sum": "The score is taken for a sum over the steps of an episode.",
                "average": "The score is taken for an average over the steps of an episode: longer episodes do not score more.",
            }[form]
        )
    if not factors:
        return [*said, f"Raw features explain {found.by_all:.0%} of the variation of the returns of {count} episodes."]
    more = float(found.by_all - found.by_factors)
    said.append(
        f"The factors explain {found.by_factors:.0%} of the variation of the returns of {count} episodes"
        + (f", raw features another {more:.0%}." if entries and more >= 0.01 else ".")
    )
    if found.by_factors < NEXT_TO_NOTHING:
        said.append(
            "Warning: phi explains next to nothing of the score. Its factors are not what the score is made of."
        )
    else:
        said.append(
            "For each factor: its share of the variation, and by how much a step's reward rises with one standard deviation of it:"
        )
        said += [
            f"- {factors[i]}: {found.share[i]:.0%}, {found.weight[i]:+.3g} ± {found.deviation[i]:.1g}"
            + (" (its effect is curved)" if is_bent(found, i) else "")
            for i in np.argsort(-found.share, kind="stable").tolist()
        ]
    if entries and found.by_factors < 0.95 and np.abs(found.left).max() > STRIKING:
        place = int(np.argmax(np.abs(found.left)))
        way = "large" if found.left[place] > 0 else "small"
        said.append(
            f"Returns are higher than the factors predict when {entries[place]} is {way} "
            f"(correlation {found.left[place]:+.2f}): a factor may be missing."
        )
    return said
