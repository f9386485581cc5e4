"""The sections of a report on one run: what earned the score, credit, factors, functions and settings."""

import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from lare_rl.config.effective import effective_settings
from lare_rl.config.resolve import fill_in
from lare_rl.config.settings import ResolvedSettings, Settings
from lare_rl.credit import explanation_text
from lare_rl.credit.methods import METHODS
from lare_rl.envs.placement import load_env_spec
from lare_rl.errors import LareError
from lare_rl.evaluation.episode_credit import EpisodeCredit, FactorLabel, label_factors, load_episode_credit
from lare_rl.latent.saved import read_source
from lare_rl.report.charts import Bar, Chart, Line, draw_bars, draw_legend, draw_strips, visible_steps
from lare_rl.report.html import render_figures, render_fold, render_function, render_note, render_table
from lare_rl.report.messages import WORDS
from lare_rl.report.reported_run import ReportedRun
from lare_rl.runs.directory import Run, function_paths
from lare_rl.tasks.spec import base_name
from lare_rl.tasks.trust import TRUST_VARIABLE, untrusted_module
from lare_rl.training.explain import explanation_source, find_explanations
from lare_rl.util.findings import Finding, format_number, render

__all__ = ["describe_method", "render_details", "render_settings"]

MIN_BAND = 0.04
"""A band is visible if it is wider than this fraction of the range of the line."""
_BAND_NOTE = (
    " The band is ± two posterior standard deviations: the uncertainty that the returns so far leave, if the true rewards depend "
    "only on what the decoder sees."
)
_OBSERVATIONS = {"before": "before", "after": "after", "both": "before and the observation after"}
"""Texts of the observations that phi reads."""
_IN_BARS = ("factor", "unknown_factor", "about_factors", "about_shares", "about_states")
"""Codes of findings that the bars show."""
_SUMMARIES = ("factors_explain", "raw_features_explain")
"""Codes of findings that stand above the bars."""
_BAR_STYLES = {"plus": "the reward of a step rises with the factor", "minus": "it falls with the factor"}
"""The meanings of the colours of bars."""


def render_details(run: Run, trust: Sequence[str]) -> Iterable[str]:
    """Yield what a run's checkpoint and files show.

    Args:
        trust: paragraphs on the quality of the credit, which stand above its picture.
    """
    if module := untrusted_module(run.config.task):
        yield from trust
        yield from _render_untrusted(run, module)
    elif not run.has_checkpoint():
        yield from trust
    else:
        yield from _render_checkpoint(run, trust)


def _render_untrusted(run: Run, module: str) -> Iterable[str]:
    """Yield the sources of latent functions as the run's files have them, neither executed nor verified."""
    yield render_note(
        f"Its environment is of the module {module}, which is not imported for a report. Set {TRUST_VARIABLE}={module} to have it "
        "imported: random play, credit, factors and what the returns say of them then appear here."
    )
    has_files = any(run.directory.glob("latent_function*.py"))  # the runs of published results have none
    for role, path in function_paths(run.directory, run.config) if has_files else ():
        source = f"<pre>{escape(read_source(path).source)}</pre>"
        yield render_fold(f"The latent function{f' of {role.team}' if role.team else ''}", [source])


def _render_checkpoint(run: Run, trust: Sequence[str]) -> Iterable[str]:
    """Yield what earned the score, the credit of an episode, and the latent functions."""
    credit, roles = load_episode_credit(run), run.config.task.roles
    yield from _render_earnings(run, credit)
    yield from trust if credit is None else _render_credit(credit, label_factors(run), trust)
    for role, function in zip(roles, run.functions, strict=False):
        title = f"The latent function phi{f' of {role.name}' if len(roles) > 1 else ''}"
        yield render_fold(title, [render_function(function)])


def _render_credit(credit: EpisodeCredit, labels: Sequence[FactorLabel], trust: Sequence[str]) -> Iterable[str]:
    """Yield the credit of each step of an episode: of each agent or, of a single agent, also as lines, with its factors."""
    has_many_agents = credit.reward.shape[1] > 1
    rows = {"True reward": credit.reward} if credit.has_step_rewards else {}
    yield _render_heading("Credit over one episode", "proxy")
    yield from trust
    yield draw_strips(rows | {"Proxy reward": credit.proxy_reward}, shared_scale=not has_many_agents)
    note = (
        f"The last training episode of the first seed, {len(credit.reward):,} steps, exploration included, judged by the newest "
        f"decoder. The sum of the true rewards is {format_number(credit.reward.sum())}, that of the proxy rewards "
        f"{format_number(credit.proxy_reward.sum())}."
    )
    if has_many_agents:
        scales = "A decoder is fitted to sums, so each picture has its own scale."
        yield render_note(f"{note} Every agent is a row. {scales}")
    else:
        yield from _render_lines(credit, labels, note)


def _render_lines(credit: EpisodeCredit, labels: Sequence[FactorLabel], note: str) -> Iterable[str]:
    """Yield the rewards of a single agent, and the factors, as lines over the steps of an episode."""
    reward, proxy = credit.reward[:, 0], credit.proxy_reward[:, 0]
    steps = visible_steps(len(reward))
    x = np.arange(steps.start, steps.stop, dtype=float)
    lines = [Line(x, reward[steps], "grey", label="true reward")] if credit.has_step_rewards else []
    band = None if credit.uncertainty is None else credit.uncertainty[steps]
    if band is not None and band.max() < MIN_BAND * np.ptp(proxy[steps]):
        band = None
    lines.append(Line(x, proxy[steps], "c0", label="proxy reward", band=band))
    yield draw_legend((line.style, line.label) for line in lines)
    text = "Rewards over the steps of an episode"
    yield Chart(lines=lines, description=text, x_label="step of the episode").render()
    yield render_note(
        f"{note} The lines show steps {steps.start} to {steps.stop - 1}.{'' if band is None else _BAND_NOTE}"
    )
    if labels:
        yield render_fold("The factors over the same steps", [_draw_factors(credit.factors[steps, 0], x, labels)])


def _render_heading(title: str, word: str) -> str:
    """Return a heading with a link to the explanation of a word."""
    return f'<h2>{title}<a class="why" href="#{word}" title="What is a {WORDS[word][0]}?">?</a></h2>'


def _draw_factors(
    factors: Float[np.ndarray, "steps factors"], x: Float[np.ndarray, " steps"], labels: Sequence[FactorLabel]
) -> str:
    # The values after a step are those before the next, so a factor needs one curve.
    curves = {base_name(label.name): factor for label, factor in zip(labels, factors.T, strict=True)}
    charts = {}
    for name, factor in curves.items():
        text = f"{name} over the steps of an episode"
        charts[name] = Chart(lines=[Line(x, factor, "c0")], description=text, x_label="step", is_low=True).render()
    return render_figures(charts)


def _render_earnings(run: Run, credit: EpisodeCredit | None) -> Iterable[str]:
    """Yield what earned the score of each team: findings about its returns, and the numbers of its factors."""
    explanations, roles = find_explanations(run), run.config.task.roles
    if any(explanations):
        yield _render_heading("What earned the score", "share")
        source = explanation_source(run)
        text = "A bar is the share of the differences between returns that a factor explains. A bar to the left is a negative share."
        yield render_note(f"{text} {source}." if source else text)
    for team_index, role in enumerate(roles):
        findings, labels = explanations[team_index] if explanations else [], label_factors(run, team_index)
        if len(roles) > 1 and (findings or labels):
            yield f"<h3>{escape(role.name)}</h3>"
        yield from _render_findings(findings, labels)
        correlations = np.full(len(labels), np.nan) if credit is None else credit.correlations[team_index]
        table = _render_factor_table(findings, labels, correlations, run)
        yield render_fold("The numbers of the factors", table)


def _render_findings(findings: Sequence[Finding], labels: Sequence[FactorLabel]) -> Iterable[str]:
    """Yield summaries, a bar for each factor, or for the raw features with the largest shares, and remarks."""
    yield from (f"<p>{_sentence(finding, 'html')}</p>" for finding in findings if finding.code in _SUMMARIES)
    meanings = {base_name(label.name): label.meaning for label in labels}
    bars = [_make_bar(finding, meanings) for finding in findings if finding.code in ("factor", "unknown_factor")]
    bars += [bar for finding in findings for bar in _raw_feature_bars(finding)]
    if bars:
        yield draw_bars(bars)
        styles = [style for style in _BAR_STYLES if any(bar.style == style for bar in bars)]
        keys = (f'<span><i class="{style}"></i>{_BAR_STYLES[style]}</span>' for style in styles)
        yield f'<div class="sides">{"".join(keys)}</div>'
    for finding in findings:
        if finding.code not in (*_IN_BARS, *_SUMMARIES):
            yield f'<p class="note">{_sentence(finding, "html")}</p>'


def _sentence(finding: Finding, style: Literal["text", "html"] = "text") -> str:
    return render(finding, explanation_text.MESSAGES, style).removeprefix("- ")


def _make_bar(finding: Finding, meanings: Mapping[str, str]) -> Bar:
    """Return the bar of a factor: its share, in the colour of its effect."""
    name, share = finding.values["name"], float(finding.values.get("share", 0.0))
    meaning = meanings.get(name) or name.removeprefix("f_").replace("_", " ")
    slope = finding.values["effect"].values.get("slope", 0.0) if round(100 * share) else 0.0
    style = "plus" if slope > 0 else "minus" if slope < 0 else ""
    return Bar(
        text=_capitalise(meaning),
        name=name,
        amount=share,
        style=style,
        hover=_sentence(finding),
        note=_format_shape(finding.values),
    )


def _capitalise(text: str) -> str:
    return text[:1].upper() + text[1:]


def _format_shape(values: Mapping[str, Any]) -> str:
    """Return a remark on the effect of a factor that is curved, or depends on another. Empty if it is straight."""
    shape = values.get("shape")
    return "" if shape is None else render(shape, explanation_text.MESSAGES)


def _raw_feature_bars(finding: Finding) -> list[Bar]:
    largest = finding.values.get("largest") if finding.code == "raw_features_explain" else None
    features = () if largest is None else largest.values["features"]
    return [
        Bar(text=feature.values["name"], name="", amount=feature.values["share"], style="", hover="")
        for feature in features
    ]


def _render_factor_table(
    findings: Sequence[Finding], labels: Sequence[FactorLabel], correlations: Float[np.ndarray, " factors"], run: Run
) -> Iterable[str]:
    if not labels:
        return
    values = {finding.values["name"]: finding.values for finding in findings if finding.code == "factor"}
    rows = []
    for name, label in {base_name(label.name): label for label in labels}.items():
        numbers = _format_factor(values[name]) if name in values else ("", "", "")
        columns = [r for other, r in zip(labels, correlations, strict=True) if base_name(other.name) == name]
        text = " / ".join(f"{r:.2f}" for r in columns if not np.isnan(r))
        rows.append((name, label.meaning, label.reads, *numbers, text))
    header = "factor", "meaning", "entries that it reads", *_FACTOR_NUMBERS, "correlation with the true reward"
    yield render_table(header, rows, numbers=(3, 4, 5, 6))
    sides = " Correlations are of the factor before it, and after it." if run.scored_observation == "both" else ""
    yield render_note(f"phi scores the observation {_OBSERVATIONS[run.scored_observation]} the step.{sides}")


_FACTOR_NUMBERS = ("share", "effect", "effect of one unit")


def _format_factor(values: Mapping[str, Any]) -> tuple[str, str, str]:
    """Return the `_FACTOR_NUMBERS` of a factor. One unit has an effect if the effect is straight."""
    effect = render(values["effect"], explanation_text.MESSAGES) + _format_shape(values)
    per_unit = values.get("per_unit")
    return f"{values['share']:z.0%}", effect, "" if per_unit is None else f"{per_unit:+.3g}"


def render_settings(runs: Sequence[ReportedRun]) -> Iterable[str]:
    """Yield the settings: of one run, those that differ from the defaults; of several, those in which they differ."""
    configs = {reported.name: reported.run.config for reported in runs}
    columns = {
        name: _format_settings(config.settings) | {"LaRe": config.lare, **config.versions, "machine": config.machine}
        for name, config in configs.items()
    }
    if len(runs) == 1:
        (values,) = columns.values()
        defaults = _default_settings(runs[0].run)
        differing = {key for key, value in values.items() if defaults is None or value != defaults.get(key)}
        rows = [(key, value) for key, value in values.items() if key in differing | {"method", "algorithm"}]
        title = "Settings" if defaults is None else "Settings that differ from the defaults"
        header = ("setting", "value")
    else:
        keys = dict.fromkeys(key for values in columns.values() for key in values)
        table = {key: [values.get(key, "") for values in columns.values()] for key in keys}
        rows = [(key, *cells) for key, cells in table.items() if len({*cells} - {""}) > 1]
        title, header = "Settings that differ between the runs", ("setting", *columns)
    if rows:
        yield render_fold(title, [render_table(header, rows)])
    files = (
        render_fold(name, [f"<pre>{escape(config.model_dump_json(indent=1))}</pre>"])
        for name, config in configs.items()
    )
    yield render_fold("All settings (config.json)", files)


def _default_settings(run: Run) -> dict[str, str] | None:
    """Return the defaults for a run's task. None without its environment, which determines some of them."""
    settings, task = run.config.settings, run.config.task
    if untrusted_module(task) is not None:
        return None
    try:
        env = load_env_spec(task)
    except LareError:
        return None
    return _format_settings(fill_in(Settings(method=settings.method, algorithm=settings.algorithm), task, env))


def _format_settings(settings: ResolvedSettings) -> dict[str, str]:
    """Return the settings that have an effect, as texts."""
    values = effective_settings(settings).items()
    return {key: value if isinstance(value, str) else json.dumps(value) for key, value in values}


def describe_method(run: Run) -> str:
    """Return what the run's method does, its source, and where policies are evaluated, if it is elsewhere."""
    method, task = METHODS.find(run.config.settings.method), run.config.task
    sentences = [_capitalise(method.summary)]
    if method.source not in ("", "-"):
        sentences.append(f"Source: {method.source}")
    if task.evaluation_environment:
        sentences.append(f"Trained in {task.environment}, evaluated in {task.evaluation_environment}")
    return " ".join(f"{sentence}." for sentence in sentences if sentence)
