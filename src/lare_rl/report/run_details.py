"""The sections of a report on one run: what earned the score, credit, factors, functions and settings."""

import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from lare_rl.config.effective import effective_settings
from lare_rl.config.resolve import fill_in
from lare_rl.config.settings import Settings
from lare_rl.credit import explanation_text
from lare_rl.credit.methods import METHODS
from lare_rl.envs.placement import load_env_spec
from lare_rl.errors import LareError, install_command
from lare_rl.evaluation.episode_credit import FactorLabel, label_factors, load_episode_credit
from lare_rl.evaluation.played_episodes import PlayedEpisodes, TeamSample, sample_steps
from lare_rl.latent.saved import read_source
from lare_rl.report.charts import (
    Bar,
    Chart,
    Line,
    draw_bars,
    draw_legend,
    draw_points,
    draw_strips,
    visible_steps,
)
from lare_rl.report.html import render_fold, render_function, render_note, render_table
from lare_rl.report.reported_run import ReportedRun
from lare_rl.runs.directory import Run, function_paths
from lare_rl.tasks.spec import base_name
from lare_rl.tasks.trust import TRUST_VARIABLE, untrusted_module
from lare_rl.training.explain import explanation_source, find_explanations
from lare_rl.util.findings import Finding, format_number, render
from lare_rl.util.statistics import column_correlations

__all__ = ["describe_method", "render_details", "render_settings"]

TSNE_PERPLEXITY, MAX_TSNE_POINTS = 30, 1000
MIN_BAND = 0.04
"""A band is visible if it is wider than this fraction of the range of the line."""
_BAND_NOTE = (
    " The band is ± two posterior standard deviations: the uncertainty that the returns so far leave, if the true rewards depend "
    "only on what the decoder sees."
)
_OBSERVATIONS = {"before": "before", "after": "after", "both": "before and the observation after"}
"""Texts of the observations that phi reads."""
_IN_BARS = ("factor", "unknown_factor", "about_factors", "about_shares", "about_states")
"""Findings that the bars show."""
_SUMMARIES = ("factors_explain", "raw_features_explain")
"""Findings that stand above the bars."""
_BAR_STYLES = {"plus": "the reward of a step rises with the factor", "minus": "it falls with the factor"}
"""What the colours of bars say."""


def render_details(run: Run, trust: Iterable[str] = (), played: PlayedEpisodes | None = None) -> Iterable[str]:
    """Yield what a run's checkpoint and files show.

    Args:
        trust: paragraphs on the quality of the credit, which stand below its picture.
        played: an episode, for a run of many agents.
    """
    trust = list(trust)
    if module := untrusted_module(run.config.task):
        yield from trust
        yield from _render_untrusted(run, module)
    elif not run.has_checkpoint():
        yield from trust
    elif played is None:
        yield from _render_single_agent(run, trust)
    else:
        yield from _render_agents(run, played, trust)


def _render_untrusted(run: Run, module: str) -> Iterable[str]:
    """Yield the sources of latent functions as the run's files have them. Nothing has executed or verified them."""
    yield render_note(
        f"Its environment is of the module {module}, which is not imported for a report. Set {TRUST_VARIABLE}={module} to have it "
        "imported: random play, credit, factors and what the returns say of them then appear here."
    )
    has_files = any(run.directory.glob("latent_function*.py"))  # the runs of published results have none
    for role, path in function_paths(run.directory, run.config) if has_files else ():
        source = f"<pre>{escape(read_source(path).source)}</pre>"
        yield render_fold(f"The latent function{f' of {role.team}' if role.team else ''}", [source])


def _render_single_agent(run: Run, trust: Sequence[str]) -> Iterable[str]:
    credit, labels = load_episode_credit(run), label_factors(run)
    correlations = np.full(len(labels), np.nan) if credit is None else credit.correlations
    yield from _render_earnings(run, [correlations])
    if credit is not None:
        reward, proxy = credit.reward[:, 0], credit.training_reward[:, 0]
        rows = {"True reward": reward[:, None]} if credit.has_step_rewards else {}
        yield '<h2>Credit over one episode<a class="why" href="#proxy" title="What is a proxy reward?">?</a></h2>'
        yield from trust
        yield draw_strips(rows | {"Proxy reward": proxy[:, None]}, shared_scale=True)
        steps = visible_steps(len(reward))
        x = np.arange(steps.start, steps.stop, dtype=float)
        lines = [Line(x, reward[steps], "grey", "true reward")] if credit.has_step_rewards else []
        band = None if credit.uncertainty is None else credit.uncertainty[steps]
        if band is not None and band.max() < MIN_BAND * np.ptp(proxy[steps]):
            band = None
        band_note = "" if band is None else _BAND_NOTE
        lines.append(Line(x, proxy[steps], "c0", "proxy reward", band))
        yield draw_legend((line.style, line.label) for line in lines)
        yield Chart(
            lines=lines, description="Rewards over the steps of an episode", x_label="step of the episode"
        ).render()
        yield render_note(
            f"The last training episode of the first seed, {len(reward):,} steps, exploration included, judged by the newest "
            f"decoder. The lines show steps {steps.start} to {steps.stop - 1}. Return {format_number(reward.sum())}, sum of the proxy "
            f"rewards {format_number(proxy.sum())}.{band_note}"
        )
        if labels:
            yield render_fold("The factors over the same steps", _draw_factors(credit.factors[steps, 0], x, labels))
    else:
        yield from trust
    if run.function is not None:
        yield render_fold("The latent function phi", [render_function(run.function)])


def _draw_factors(
    factors: Float[np.ndarray, "steps factors"], x: Float[np.ndarray, " steps"], labels: Sequence[FactorLabel]
) -> Iterable[str]:
    yield '<div class="figures">'
    # The values before a step are those after the previous one, so one curve of a factor is enough.
    curves = {base_name(label.name): factor for label, factor in zip(labels, factors.T, strict=True)}
    for name, factor in curves.items():
        text = f"{name} over the steps of an episode"
        chart = Chart(lines=[Line(x, factor, "c0")], description=text, x_label="step", is_low=True).render()
        yield f'<figure><figcaption class="title">{escape(name)}</figcaption>{chart}</figure>'
    yield "</div>"


def _render_earnings(run: Run, correlations: Sequence[Float[np.ndarray, " factors"]]) -> Iterable[str]:
    """Yield what earned the score: a bar for each factor, or for the raw features with the largest shares; for each team."""
    explanations, roles = find_explanations(run), run.config.task.roles
    sections: list[str] = []
    for team_index, role in enumerate(roles):
        findings = explanations[team_index] if team_index < len(explanations) else []
        labels = label_factors(run, team_index)
        if len(roles) > 1 and (findings or labels):
            sections.append(f"<h3>{escape(role.name)}</h3>")
        meanings = {base_name(label.name): label.meaning for label in labels}
        bars = [_make_bar(finding, meanings) for finding in findings if finding.code in ("factor", "unknown_factor")]
        bars += [bar for finding in findings for bar in _raw_feature_bars(finding)]
        sections += [f"<p>{_sentence(finding, 'html')}</p>" for finding in findings if finding.code in _SUMMARIES]
        if bars:
            styles = {bar.style for bar in bars}
            texts = (
                f'<span><i class="{style}"></i>{text}</span>' for style, text in _BAR_STYLES.items() if style in styles
            )
            sections += [draw_bars(bars), f'<div class="sides">{"".join(texts)}</div>']
        sections += [
            f'<p class="note">{_sentence(finding, "html")}</p>'
            for finding in findings
            if finding.code not in (*_IN_BARS, *_SUMMARIES)
        ]
        sections.append(
            render_fold(
                "The numbers of the factors", _render_factor_table(findings, labels, correlations[team_index], run)
            )
        )
    if any(explanations):
        yield '<h2>What earned the score<a class="why" href="#share" title="What is a share?">?</a></h2>'
        source = explanation_source(run)
        text = (
            "A bar is the share of the differences between returns that a factor explains. A bar to the left is a negative share: the "
            "factor offsets others."
        )
        yield render_note(f"{text} {source}." if source else text)
    yield from sections


def _sentence(finding: Finding, style: Literal["text", "html"] = "text") -> str:
    return render(finding, explanation_text.MESSAGES, style).removeprefix("- ")


def _make_bar(finding: Finding, meanings: Mapping[str, str]) -> Bar:
    """Return the bar of a factor: its share, in the colour of its effect."""
    name, share = finding.values["name"], float(finding.values.get("share", 0.0))
    meaning = meanings.get(name) or name.removeprefix("f_").replace("_", " ")
    slope = finding.values["effect"].values.get("slope", 0.0) if round(100 * share) else 0.0
    style = "plus" if slope > 0 else "minus" if slope < 0 else ""
    return Bar(meaning[:1].upper() + meaning[1:], name, share, style, _sentence(finding), _shape(finding.values))


def _shape(values: Mapping[str, Any]) -> str:
    """Return what else there is to say about a factor's effect; empty if it is straight."""
    shape = values.get("shape")
    return "" if shape is None else render(shape, explanation_text.MESSAGES)


def _raw_feature_bars(finding: Finding) -> list[Bar]:
    largest = finding.values.get("largest") if finding.code == "raw_features_explain" else None
    features = () if largest is None else largest.values["features"]
    return [Bar(feature.values["name"], "", feature.values["share"], "", "") for feature in features]


def _render_factor_table(
    findings: Sequence[Finding], labels: Sequence[FactorLabel], correlations: Float[np.ndarray, " factors"], run: Run
) -> Iterable[str]:
    if not labels:
        return
    values = {finding.values["name"]: finding.values for finding in findings if finding.code == "factor"}
    rows = []
    for name, label in {base_name(label.name): label for label in labels}.items():
        numbers = _factor_numbers(values[name]) if name in values else ("", "", "")
        both = [r for other, r in zip(labels, correlations, strict=True) if base_name(other.name) == name]
        text = " / ".join(f"{r:.2f}" for r in both if not np.isnan(r))
        rows.append((name, label.meaning, label.reads, *numbers, text))
    header = (
        "factor",
        "meaning",
        "entries that it reads",
        "share",
        "effect",
        "effect of one unit",
        "correlation with the true reward",
    )
    yield render_table(header, rows, numbers=(3, 4, 5, 6))
    two = " Correlations are of the factor before it, and after it." if run.scored_observation == "both" else ""
    yield render_note(f"phi scores the observation {_OBSERVATIONS[run.scored_observation]} the step.{two}")


def _factor_numbers(values: Mapping[str, Any]) -> tuple[str, str, str]:
    """Return the share of a factor, its effect, and the effect of one unit of it if the effect is straight."""
    effect = render(values["effect"], explanation_text.MESSAGES) + _shape(values)
    per_unit = values.get("per_unit")
    return f"{values['share']:z.0%}", effect, "" if per_unit is None else f"{per_unit:+.3g}"


def _render_agents(run: Run, played: PlayedEpisodes, trust: Sequence[str]) -> Iterable[str]:
    """Yield what earned the score of each team, the credit of each agent and step, and the factors."""
    samples = sample_steps(run) if run.functions else []
    yield from _render_earnings(
        run, [sample.correlations for sample in samples] or [np.zeros(0)] * len(run.config.task.roles)
    )
    reward, proxy = played.select_episode((played.reward, played.training_reward))
    sums = f"Sum of the true rewards {format_number(reward.sum())}"
    if proxy is not None:
        sums += f", of the proxy rewards {format_number(proxy.sum())}"
    yield '<h2>Who got which credit when<a class="why" href="#proxy" title="What is a proxy reward?">?</a></h2>'
    yield from trust
    yield draw_strips({"True reward": reward} | ({} if proxy is None else {"Proxy reward": proxy}), shared_scale=False)
    yield render_note(
        f"One episode of the first seed's policy, from left to right; every agent is a row. {sums}. A decoder is fitted to sums, so "
        "each picture has its own scale."
    )
    for team_index, sample in enumerate(samples):
        name = run.config.task.roles[team_index].name
        raw, latent = (
            np.nanmean(np.abs(values))
            for values in (column_correlations(sample.next_observation, sample.reward), sample.correlations)
        )
        text = (
            f"Absolute correlation with the true reward, mean over dimensions: {raw:.2f} for the "
            f"{sample.next_observation.shape[1]} entries of an observation, {latent:.2f} for the {len(sample.correlations)} factors."
        )
        yield render_fold(
            f"The latent function of {name}",
            [render_note(text), *_render_tsne(sample), render_function(run.functions[team_index])],
        )


def _render_tsne(sample: TeamSample) -> Iterable[str]:
    """Yield t-SNE pictures of observations and of factors, coloured by the true reward (the paper's appendix G)."""
    try:
        from sklearn.manifold import TSNE
    except ImportError:
        yield render_note(f"A t-SNE picture of observations and factors is drawn here after {install_command('tsne')}.")
        return
    chosen = np.random.default_rng(0).permutation(len(sample.reward))[:MAX_TSNE_POINTS]
    if len(chosen) <= TSNE_PERPLEXITY:
        return
    yield '<div class="figures">'
    for name, columns in {"observations": sample.next_observation, "factors": sample.factors}.items():
        if columns.shape[1] < 2:  # a plane needs two columns
            continue
        rows = columns[chosen]
        rows = (rows - rows.mean(axis=0)) / np.maximum(rows.std(axis=0), 1e-9)
        points = TSNE(perplexity=TSNE_PERPLEXITY, init="pca", random_state=0).fit_transform(rows)
        yield draw_points(points, sample.reward[chosen], f"t-SNE of the {name} of agents. Bright: a high true reward.")
    yield "</div>"


def render_settings(runs: Sequence[ReportedRun]) -> Iterable[str]:
    """Yield the settings: of one run, those that differ from the defaults; of several, those in which they differ."""
    configs = {reported.name: reported.run.config for reported in runs}
    columns = {
        name: {key: _to_text(value) for key, value in effective_settings(config.settings).items()}
        | {"LaRe": config.lare, **config.versions, "machine": config.machine}
        for name, config in configs.items()
    }
    if len(runs) == 1:
        (values,) = columns.values()
        defaults = _default_settings(runs[0].run)
        rows = [
            (key, value)
            for key, value in values.items()
            if defaults is None or value != defaults.get(key) or key in ("method", "algorithm")
        ]
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
    """Return the defaults for a run's task. None if its environment, which decides some, must not be imported, or is not installed."""
    settings, task = run.config.settings, run.config.task
    if untrusted_module(task) is not None:
        return None
    try:
        env = load_env_spec(task)
    except LareError:
        return None
    defaults = fill_in(Settings(method=settings.method, algorithm=settings.algorithm), task, env)
    return {key: _to_text(value) for key, value in effective_settings(defaults).items()}


def _to_text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def describe_method(run: Run) -> str:
    """Return what the run's method does, its source, and where policies are evaluated, if it is elsewhere."""
    method, task = METHODS.find(run.config.settings.method), run.config.task
    source = "" if method.source == "-" else f" Source: {method.source}."
    environments = (
        f" Trained in {task.environment}, evaluated in {task.evaluation_environment}."
        if task.evaluation_environment
        else ""
    )
    return f"{method.summary[0].upper()}{method.summary[1:]}.{source}{environments}"
