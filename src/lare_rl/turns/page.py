"""The report of credited rollouts: a few of them as strips of turns, the effects of features, and how far to trust the credit."""

import itertools
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from lare_rl.errors import abbreviate
from lare_rl.report.figures import COLOURS, make_figure, to_svg
from lare_rl.report.html import render_note, render_table, write_page
from lare_rl.turns.credit import EFFECT_KINDS, CreditedTurns
from lare_rl.turns.messages import Turn, split_turns
from lare_rl.turns.rollouts import Rollout
from lare_rl.turns.words import MESSAGES, count_decimals
from lare_rl.util.findings import format_for_reader, render
from lare_rl.util.provenance import code_version
from lare_rl.util.sanitize import one_line

__all__ = ["choose_rollouts", "write_turn_report"]

N_STRIPS = 6
"""The number of rollouts that are drawn."""
MAX_TURNS = 60
"""The largest number of turns of a strip."""
MAX_CHARACTERS = 90
"""Characters of a turn's text, and of its features."""

NOTE_SUMS = (
    "Progress is the change of the expected outcome that a turn made. The proxy rewards of lare-rl relabel are something else: their "
    "sum predicts the outcome, and they must not be used as advantages of turns."
)
NOTE_DEVIATIONS = (
    "The error bars are two posterior standard deviations. They contain the exact change of value in only about half of the turns, "
    "because they leave out what the features miss. If an error bar does not reach 0, the sign of the progress is usually right."
)


def write_turn_report(
    path: Path, rollouts: Sequence[Mapping[str, Any]], checked: Sequence[Rollout], credit: CreditedTurns
) -> Path:
    """Write the page as one self-contained HTML file.

    Args:
        path: the file.
        rollouts: the rollouts as mappings, with their messages.
        checked: the same from `read_rollouts`.
        credit: their credit.

    Raises:
        LareError: the file cannot be written. An older file is left unchanged.
    """
    n_turns = format_for_reader(sum(len(rollout.turns) for rollout in checked), "count turn")
    title = f"Credit for {n_turns} of {format_for_reader(len(checked), 'count rollout')}"
    outcome = np.array([rollout.outcome for rollout in checked])
    trust, *effects = (render(finding, MESSAGES, "html") for finding in credit.findings)
    body = [
        f"<h1>{escape(title)}</h1>",
        f'<div class="verdict"><p>{trust}</p></div>',
        render_note(f"Outcomes: mean {outcome.mean():.3g}, from {outcome.min():.3g} to {outcome.max():.3g}."),
        "<h2>What matters</h2>",
        "<ul>" + "".join(f"<li>{line}</li>" for line in effects) + "</ul>"
        if effects
        else render_note("No feature of a turn changes the value clearly."),
        _render_effects(credit),
        "<h2>Some rollouts</h2>",
        render_note(NOTE_DEVIATIONS),
    ]
    for k in choose_rollouts(checked, credit):
        body += _render_rollout(k, rollouts[k], checked[k], credit)
    body += [render_note(NOTE_SUMS), render_note(f"Written by LaRe {code_version()}.")]
    return write_page(path, title, "\n".join(body))


def choose_rollouts(checked: Sequence[Rollout], credit: CreditedTurns) -> list[int]:
    """Return the indices of rollouts to draw: alternately above and below the mean outcome, those with the clearest turns first.

    The last turn does not count: its progress is the rest of the outcome, and is always large.
    """
    clarity = [
        float(np.max(np.abs(progress[:-1]) - 2 * std[:-1], initial=-np.inf))
        for progress, std in zip(credit.progress, credit.deviation, strict=True)
    ]
    mean = np.mean([rollout.outcome for rollout in checked])
    order = sorted(range(len(checked)), key=lambda k: -clarity[k])
    high = [k for k in order if checked[k].outcome > mean]
    low = [k for k in order if checked[k].outcome <= mean]
    mixed = [k for pair in itertools.zip_longest(high, low) for k in pair if k is not None]
    return mixed[:N_STRIPS]


def _render_rollout(k: int, rollout: Mapping[str, Any], checked: Rollout, credit: CreditedTurns) -> list[str]:
    group = f", group {_shorten(checked.group)}" if checked.group else ""
    value, n_turns, decimals = credit.value[k], len(checked.turns), count_decimals(credit.trust.outcome_std)
    ending = ", cut off" if checked.truncated else ""
    if n_turns > MAX_TURNS:
        ending += f" (the first {MAX_TURNS} of {n_turns} turns)"
    rows = []
    messages = rollout.get("messages")
    turns = [None] * n_turns if messages is None else split_turns(messages, f"rollout {k}")
    for t, (features, turn) in enumerate(zip(checked.turns[:MAX_TURNS], turns[:MAX_TURNS], strict=True)):
        progress = _format_change(credit.progress[k][t], credit.deviation[k][t], decimals)
        numbers = f"{value[t]:.{max(0, decimals - 1)}f}", progress, f"{credit.advantage[k][t]:+.{decimals}f}"
        rows.append((str(t + 1), _describe_turn(turn), _describe_features(features), *numbers))
    header = ("turn", "the assistant", "features", "value before", "progress", "advantage")
    table = render_table(header, rows, numbers=(0, 3, 4, 5))
    return [
        f"<h3>Rollout {k}{escape(group)}: outcome {checked.outcome:g}{ending}</h3>",
        _draw_strip(credit.progress[k][:MAX_TURNS], credit.deviation[k][:MAX_TURNS]),
        f"<details><summary>The turns</summary>{table}</details>",
    ]


def _draw_strip(progress: np.ndarray, std: np.ndarray) -> str:
    """Draw the progress of each turn as a bar, with two posterior standard deviations."""
    figure, (axes,) = make_figure(height=1.9)
    turns = np.arange(1, len(progress) + 1)
    colours = np.where(progress >= 0, COLOURS[0], COLOURS[1])
    axes.bar(turns, progress, color=colours, yerr=2 * std, error_kw={"elinewidth": 1, "ecolor": "#777777"})
    axes.axhline(0, color="#777777", linewidth=0.8)
    axes.set(xlabel="turn", ylabel="progress", xlim=(0.4, len(progress) + 0.6))
    axes.xaxis.get_major_locator().set_params(integer=True)
    return to_svg(figure)


def _describe_turn(turn: Turn | None) -> str:
    if turn is None:
        return "-"
    calls = ", ".join(f"{call.tool}({call.arguments})" for call in turn.calls)
    return _shorten(calls or turn.text) or "-"


def _describe_features(features: Mapping[str, float]) -> str:
    texts = (name if value == 1 else f"{name} {value:.3g}" for name, value in features.items() if value)
    return _shorten(", ".join(texts)) or "-"


def _shorten(text: str) -> str:
    return abbreviate(one_line(text), MAX_CHARACTERS)


def _format_change(number: float, std: float, decimals: int) -> str:
    return f"{number:+.{decimals}f} ± {std:.{decimals}f}"


def _render_effects(credit: CreditedTurns) -> str:
    """Return the table of effects. The evidence has switched a feature off whose effects are 0 without a deviation."""
    rows, decimals = [], count_decimals(credit.trust.outcome_std)
    for effect in sorted(credit.effects, key=lambda effect: -effect.importance):
        pairs = ((getattr(effect, name), getattr(effect, f"{name}_std")) for name in EFFECT_KINDS)
        numbers = (_format_change(*pair, decimals) if round(max(map(abs, pair)), decimals) else "0" for pair in pairs)
        name = effect.name if effect.feature_size == 1 else f"{effect.name} ({effect.feature_size:.3g})"
        rows.append((name, f"{effect.frequency:.0%}", *numbers))
    header = ("feature of a turn", "turns with it", "the first one", "what lasts", "each further one")
    return render_table(header, rows, numbers=(1, 2, 3, 4))
