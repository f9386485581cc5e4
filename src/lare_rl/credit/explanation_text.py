"""Sentences that say how well the factors explain returns, which factors matter, and what may be missing."""

import re

import numpy as np

from lare_rl.credit.explanation import Explanation
from lare_rl.credit.returns import FormFound

FEWEST = 20
"""With fewer episodes, there are no sentences."""
NEXT_TO_NOTHING = 0.1
"""There is a warning if the factors explain less than this share of the variation of the returns."""
NOTICEABLE = 0.05
"""The form of a factor's effect is only reported if its share of the variation is larger than this."""
STRAIGHT = 0.8
"""The effect of a factor is curved if the closest line has less than this part of its variance."""
MUCH = 0.1
"""The raw entries that explain most are named if they add more than this share of the variation to what the factors explain."""
KNOWN, CANCELLED = 2.0, 0.1
"""The change of a factor is paid if its effects before and after a step are each larger than so many of their deviations, and their
sum is smaller than this part of the larger one."""
STRIKING = 0.3
"""A raw entry is reported if its correlation with the residual of the factors is larger than this."""
FORMS = ("a sum", "an average")
"""The forms that a score may have."""


def entry_names(observation: str, action: str, entries: int, action_size: int, both: bool) -> list[str]:
    """Names of the raw entries, from a task's texts: the line `7: angle of the foot` names entry 7.

    Args:
        observation: the text that describes the observation.
        action: the text that describes the action.
        entries: the number of raw entries: 0, or at least `action_size`.
        action_size: the number of entries of the action, which come last.
        both: whether there are the entries of two observations, first those of the one before the step.
    """

    def named(text: str, count: int, kind: str) -> list[str]:
        lines = dict(re.findall(r"^[\s\-*\[]*(\d+)\]?\s*[:.)]\s*(.+)$", text, flags=re.MULTILINE))
        return [
            f"entry {i} of the {kind}" + (f" ({lines[str(i)].strip()})" if str(i) in lines else "")
            for i in range(count)
        ]

    shown = max(0, entries - action_size)
    kinds = ["observation before the step", "observation after the step"] if both else ["observation"]
    of_observations = [name for kind in kinds for name in named(observation, shown // len(kinds), kind)]
    return of_observations + named(action, entries - shown, "action")


def form_of_effect(found: Explanation, factor: int) -> str:
    """A remark on a factor whose reward does not simply rise or fall with it; empty if it does."""
    if found.share[factor] <= NOTICEABLE:
        return ""
    if found.paired[factor] > found.share[factor] / 2:
        return " (its effect depends on another factor)"
    return " (its effect is curved)" if found.linear[factor] < STRAIGHT else ""


def factor_lines(found: Explanation, names: list[str]) -> list[str]:
    """A line on each factor, those with the largest shares first. Its values before and after a step have one line."""
    places: dict[str, list[int]] = {}
    for place, name in enumerate(names):
        places.setdefault(name.removesuffix(" (before)").removesuffix(" (after)"), []).append(place)
    order = sorted(places, key=lambda name: -abs(float(found.share[places[name]].sum())))
    lines = [factor_line(found, name, places[name]) for name in order]
    if any(len(some) == 2 and found.varied[some].all() for some in places.values()):
        lines.append(
            "In brackets are the parts of the states before and after the step. If their ± are as large as the numbers, the fit "
            "cannot tell the two apart, and only their sum counts. If they are much larger than their sum, the change of the "
            "factor in a step is paid."
        )
    return lines


SAME_MEAN = "its mean is the same in all episodes, so returns do not tell what it pays"


def factor_line(found: Explanation, name: str, places: list[int]) -> str:
    """The line on a factor that has one place or two: before and after the step."""
    varied = [place for place in places if found.varied[place]]
    if not varied:
        return f"- {name}: {SAME_MEAN}"
    effects = [effect(found, [place]) if place in varied else SAME_MEAN for place in places]
    parts = f" (before: {effects[0]}; after: {effects[1]})" if len(places) == 2 else ""
    remark = next((said for place in varied if (said := form_of_effect(found, place))), "")
    sum_of_both = "its change in a step is paid" if is_change(found, varied) else effect(found, varied)
    return f"- {name}: {found.share[varied].sum():z.0%}, {sum_of_both}{parts}{remark}"


def is_change(found: Explanation, places: list[int]) -> bool:
    """Whether the effects before and after a step cancel, so that only the change of the factor matters.

    Their sum says nothing then: it is small, and its sign may come from a difference between the two standard deviations.
    """
    slope, deviation = found.slope[places], np.sqrt(np.diagonal(found.uncertainty)[places])
    known = np.all(np.abs(slope) > KNOWN * deviation)
    return bool(len(places) == 2 and known and abs(slope.sum()) < CANCELLED * np.abs(slope).max())


def effect(found: Explanation, places: list[int]) -> str:
    """The sum of the slopes at some places, with its posterior deviation."""
    variance = float(found.uncertainty[np.ix_(places, places)].sum())
    return f"{found.slope[places].sum():+.3g} ± {np.sqrt(max(variance, 0)):.1g}"


def words(found: Explanation, form: FormFound | None, factors: list[str], entries: list[str]) -> list[str]:
    """The sentences, one in each string.

    Args:
        found: the explanation of one team's score.
        form: the form as which the score is treated; None if it is given or makes no difference.
        factors: names of the factors; empty for a method without factors.
        entries: names of the raw entries; empty if they have none. Then nothing is said of single entries.
    """
    count = int(found.episodes)
    if count < FEWEST:
        return []
    if not np.isfinite(found.by_all):
        return [
            "There is nothing to explain: in all episodes the return is the same, or, if the score is a sum, the mean reward of a "
            "step."
        ]
    said = []
    if form is not None:
        this, other = FORMS[int(form.average)], FORMS[1 - int(form.average)]
        why = (
            f"this predicts returns better than {other}" if form.decided else f"{other} predicts returns about as well"
        )
        said.append(
            f"The score is treated as {this} over the steps of an episode: so far, {why}. This may change. If you know which of "
            'them it is, set it: `score = "sum"` or `score = "average"` in the task file, `--credit.score`, or '
            "`CreditSettings(score=...)`."
        )
    what = f"the mean reward of a step in {count} episodes" if found.of_steps else f"the returns of {count} episodes"
    if not factors:
        shares = f" The largest shares: {named}." if (named := largest(found, entries)) else ""
        return [*said, f"Raw entries explain {found.by_all:.0%} of the variation of {what}.{shares}"]
    more = float(found.by_all - found.by_factors)
    said.append(
        f"The factors explain {found.by_factors:.0%} of the variation of {what}"
        + (f", raw entries another {more:.0%}." if entries and more >= 0.01 else ".")
    )
    if found.by_factors < NEXT_TO_NOTHING:
        said.append(
            "Warning: phi explains next to nothing of the score. Its factors are not what the score is made of, or the episodes "
            "are too few or too much alike to show it."
        )
    else:
        said.append(
            "For each factor: its share of the variation (0%: it does not matter, or its mean hardly differed between episodes; "
            "below 0%: it offsets others), and by how much a step's reward rises with one standard deviation of it:"
        )
        said += factor_lines(found, factors)
    if entries and more > MUCH and (named := largest(found, entries)):
        said.append(
            f"In a fit on factors and raw entries, these entries have the largest shares: {named}. phi may lack a factor that is "
            "computed from them."
        )
    if entries and found.by_factors < 0.95 and np.abs(found.left).max() > STRIKING:
        place = int(np.argmax(np.abs(found.left)))
        way = "large" if found.left[place] > 0 else "small"
        both = any(name.endswith(" (after)") for name in factors)
        other_states = "" if both else ", or the task's `judges` may be wrong"
        said.append(
            f"Returns are higher than the factors predict when {entries[place]} is {way} "
            f"(correlation {found.left[place]:+.2f}): a factor may be missing{other_states}."
        )
    return said


def largest(found: Explanation, entries: list[str]) -> str:
    """The three raw entries with the largest shares, and these; empty if none is noticeable, or if they have no names."""
    order = np.argsort(-np.asarray(found.of_entries))[:3] if entries else ()
    noticeable = [place for place in order if found.of_entries[place] > NOTICEABLE]
    return ", ".join(f"{entries[place]} {found.of_entries[place]:.0%}" for place in noticeable)


def r2_shown(value: float) -> str:
    """An R^2 as text, with a third digit near 1."""
    return f"{value:.3f}" if value > 0.99 else f"{value:.2f}"


def error_shown(error: float) -> str:
    """The standard error of an R^2 as text."""
    return f"{error:.1g}" if error >= 0.001 else "less than 0.001"
