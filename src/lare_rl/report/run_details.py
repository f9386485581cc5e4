"""The sections of a report on one run: credit, factors, functions and settings."""

import json
from collections.abc import Iterable
from html import escape

import numpy as np
from jaxtyping import Float

from lare_rl.config.effective import effective_settings
from lare_rl.config.resolve import apply_defaults
from lare_rl.config.settings import Settings
from lare_rl.credit.methods import find_method
from lare_rl.envs.families import load_env_spec
from lare_rl.errors import LareError, install_command
from lare_rl.evaluation.episode_credit import EpisodeCredit, label_factors, load_episode_credit
from lare_rl.evaluation.rollout import TeamSample, roll_out, sample_steps
from lare_rl.evaluation.video import encode_gif, render_rollout
from lare_rl.latent.saved import read_source
from lare_rl.report.figures import draw_credit, draw_credit_map, draw_factors, draw_scatters, visible_steps
from lare_rl.report.html import (
    render_factor_table,
    render_function,
    render_gif,
    render_lines,
    render_note,
    render_table,
)
from lare_rl.runs.directory import Run, function_paths
from lare_rl.tasks.trust import TRUST_VARIABLE, untrusted_module
from lare_rl.training.explain import explain_run
from lare_rl.util.statistics import column_correlations

__all__ = ["FILM", "render_agents", "render_run"]

FILM = "film.gif"
"""The film in a run's directory."""
MAX_FILM_BYTES = 64 << 20
"""The largest film that a page shows."""
MAX_TSNE_POINTS = 1000
_OBSERVATIONS = {"before": "before", "after": "after", "both": "before and the observation after"}
"""Texts of the observations that phi reads."""


def render_run(name: str, run: Run) -> Iterable[str]:
    """Yield all sections on one run."""
    method = find_method(run.config.settings.method)
    summary = method.summary[0].upper() + method.summary[1:]
    yield f"<h2>{escape(name)} on {escape(run.config.task.name)}</h2>"
    yield f"<p>{escape(summary)}. Source: {escape(method.source)}.</p>"
    if module := untrusted_module(run.config.task):
        yield from _render_untrusted(run, module)
    elif run.has_checkpoint():
        film = run.directory / FILM  # by `lare-rl report --film`
        shows_film = film.is_file() and film.stat().st_size <= MAX_FILM_BYTES
        yield render_gif(film.read_bytes(), "one episode of the policy") if shows_film else ""
        if lines := explain_run(run):
            yield "<h3>What the returns say</h3>"
            yield render_lines(lines)
        yield from render_agents(run) if load_env_spec(run.config.task).n_agents > 1 else _render_single_agent(run)
    else:
        yield render_note("The run has no checkpoint any more, so credit and factors cannot be drawn.")
    yield from _render_settings(run)


def _render_untrusted(run: Run, module: str) -> Iterable[str]:
    """Yield the sources of latent functions as the run's files have them. Nothing has executed or verified them."""
    yield render_note(
        f"Its environment is of the module {module}, which is not imported for a report. Set {TRUST_VARIABLE}={module} to have it "
        "imported: random play, credit, factors and what the returns say of them then appear here."
    )
    for role, path in function_paths(run.directory, run.config):
        yield f"<h3>The latent function{f' of {escape(role.team)}' if role.team else ''}</h3>"
        yield f"<pre>{escape(read_source(path).source)}</pre>"


def _render_single_agent(run: Run) -> Iterable[str]:
    credit = load_episode_credit(run)
    if credit is not None:
        yield from _render_credit(credit)
    if run.function is not None:
        yield from _render_factors(run, credit)
        yield "<h3>The latent function</h3>"
        yield render_function(run.function)


def _render_credit(credit: EpisodeCredit) -> Iterable[str]:
    """Yield the figure of an episode's proxy rewards, and its explanation."""
    reward, proxy_reward = credit.reward[:, 0], credit.training_reward[:, 0]
    steps = visible_steps(len(reward))
    points = ", the points all steps" if credit.has_step_rewards else ""
    band = (
        ""
        if credit.uncertainty is None
        else " The band is ± two posterior standard deviations: the uncertainty that the returns so far leave, if the true rewards "
        "depend only on what the decoder sees."
    )
    yield f"<h3>Credit over one episode ({len(reward)} steps)</h3>"
    yield draw_credit(reward if credit.has_step_rewards else None, proxy_reward, credit.uncertainty)
    yield render_note(
        "The last training episode of the first seed, exploration included, judged by the newest decoder: the curve shows steps "
        f"{steps.start} to {steps.stop - 1}{points}. Return {reward.sum():.1f}, sum of the proxy rewards {proxy_reward.sum():.1f}."
        f"{band}"
    )


def _render_factors(run: Run, credit: EpisodeCredit | None) -> Iterable[str]:
    labels = label_factors(run)
    yield "<h3>The factors</h3>"
    yield render_factor_table(labels, np.full(len(labels), np.nan) if credit is None else credit.correlations)
    if credit is not None:
        yield draw_factors(credit.factors[:, 0], [label.name for label in labels])
    yield render_note(f"phi scores the observation {_OBSERVATIONS[run.scored_observation]} the step.")


def render_agents(run: Run, max_tsne_points: int = MAX_TSNE_POINTS) -> Iterable[str]:
    """Yield the credit of each agent and step, a film of the episode, and the factors of each team."""
    rollout = roll_out(run)
    reward, proxy_reward = rollout.select_episode((rollout.reward, rollout.training_reward))
    sums = f"Sum of the true rewards {reward.sum():.1f}"
    if proxy_reward is not None:
        sums += f", of the proxy rewards {proxy_reward.sum():.1f}"
    yield "<h3>Who got which credit when</h3>"
    yield draw_credit_map(reward, proxy_reward)
    yield render_note(
        f"One episode of the first seed's policy, every agent a row. {sums}. A film shows the credit beside each agent as "
        "number and colour: blue for more, red for less."
    )
    try:
        frames = render_rollout(run, rollout)
    except LareError as error:  # some packages draw no pictures of their environments
        frames = None
        yield render_note(f"There is no film: {error}.")
    if frames is not None:
        yield render_gif(encode_gif(frames), "one episode, with the credit of each agent")
    if run.functions:
        for team_index, sample in enumerate(sample_steps(run)):
            yield from _render_team(run, team_index, sample, max_tsne_points)


def _render_team(run: Run, team_index: int, sample: TeamSample, max_tsne_points: int) -> Iterable[str]:
    """Yield a team's factors and its latent function."""
    name = escape(run.config.task.roles[team_index].name)
    observation_correlations = column_correlations(sample.next_observation, sample.reward)
    raw, latent = (np.nanmean(np.abs(values)) for values in (observation_correlations, sample.correlations))
    yield f"<h3>The factors of {name}</h3>"
    yield render_factor_table(label_factors(run, team_index), sample.correlations)
    yield render_note(
        f"Absolute correlation with the true reward, mean over dimensions: {raw:.2f} for the {len(observation_correlations)} "
        f"numbers of an observation, {latent:.2f} for the {len(sample.correlations)} factors."
    )
    yield from _render_tsne(sample, max_tsne_points)
    yield f"<h3>The latent function of {name}</h3>"
    yield render_function(run.functions[team_index])


def _render_tsne(sample: TeamSample, max_points: int) -> Iterable[str]:
    """Yield t-SNE pictures of observations and of factors, coloured by the true reward (the paper's appendix G)."""
    try:
        from sklearn.manifold import TSNE
    except ImportError:
        yield render_note(f"A t-SNE picture of observations and factors is drawn here after {install_command('tsne')}.")
        return
    points = np.random.default_rng(0).permutation(len(sample.reward))[:max_points]

    def embed(columns: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "points 2"]:
        rows = columns[points]
        rows = (rows - rows.mean(axis=0)) / np.maximum(rows.std(axis=0), 1e-9)
        return TSNE(init="pca", random_state=0).fit_transform(rows)

    embeddings = {"observations": embed(sample.next_observation), "factors": embed(sample.factors)}
    yield draw_scatters(embeddings, sample.reward[points])
    yield render_note("t-SNE of steps of agents: similar steps are close together. Colour: the true reward.")


def _render_settings(run: Run) -> Iterable[str]:
    """Yield a table of the settings that differ from the defaults. All settings are folded away below it."""
    config, settings, default_settings = run.config, run.config.settings, {}
    if untrusted_module(config.task) is None:
        defaults = Settings(method=settings.method, algorithm=settings.algorithm)
        default_settings = effective_settings(apply_defaults(defaults, load_env_spec(config.task)))
    rows = [
        (key, value if isinstance(value, str) else json.dumps(value))
        for key, value in effective_settings(settings).items()
        if value != default_settings.get(key) or key in ("method", "algorithm")
    ]
    versions = ", ".join(f"{library} {version}" for library, version in config.versions.items())
    rows += [("LaRe", f"{config.lare}; {versions}"), ("machine", config.machine)]
    yield "<h3>Settings</h3>"
    yield render_table(("setting", "value"), rows)
    everything = escape(config.model_dump_json(indent=1))
    yield f"<details><summary>Everything (config.json)</summary><pre>{everything}</pre></details>"
