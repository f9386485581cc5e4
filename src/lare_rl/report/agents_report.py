"""The part of a report that only runs of many agents have."""

import base64
import io
from collections.abc import Iterable
from html import escape

import numpy as np
from jaxtyping import Float

from lare_rl.errors import pip_install
from lare_rl.evaluation.episode_credit import correlations, factor_labels
from lare_rl.evaluation.team_matches import Sample, frames, sample
from lare_rl.evaluation.video import gif
from lare_rl.evaluation.watch import Watched, watch
from lare_rl.report import figures
from lare_rl.report.html import factor_table, function_text, note
from lare_rl.runs.directory import Run

PICTURED = 1000
"""The largest number of points in a t-SNE picture."""


def agents_details(run: Run) -> Iterable[str]:
    """The credit of each agent and step, the episode as a film, the factors of each team, and a t-SNE picture of its steps."""
    watched = watch(run)
    true = watched.of_episode(watched.reward)
    proxy = None if watched.proxy is None else watched.of_episode(watched.proxy)
    yield "<h3>Who got which credit when</h3>"
    yield figures.credit_map(true, proxy)
    sums = f"Sum of the true rewards {true.sum():.1f}"
    if proxy is not None:
        sums += f", of the proxy rewards {proxy.sum():.1f}"
    yield note(
        f"One episode of the first seed's policy, every agent a row. {sums}. A film shows the credit beside each agent as "
        "number and colour: blue for more, red for less."
    )
    yield moving(run, watched)
    if run.functions:
        for place, taken in enumerate(sample(run)):
            yield from of_team(run, place, taken)


def moving(run: Run, watched: Watched) -> str:
    """The film, embedded in the page; empty for an environment that cannot be drawn."""
    pictures, buffer = frames(run, watched), io.BytesIO()
    if pictures is None:
        return ""
    gif(buffer, pictures)
    data = base64.b64encode(buffer.getvalue()).decode()
    return f'<img class="film" alt="one episode, with the credit of each agent" src="data:image/gif;base64,{data}">'


def of_team(run: Run, place: int, taken: Sample) -> Iterable[str]:
    """A team's factors and its latent function."""
    name, function = run.config.task.roles[place].name, run.functions[place]
    yield f"<h3>The factors of {escape(name)}</h3>"
    of_factors, of_observation = taken.correlations, correlations(taken.observation, taken.reward)
    yield factor_table(factor_labels(run, place), of_factors)
    raw, latent = (np.nanmean(np.abs(values)) for values in (of_observation, of_factors))
    yield note(
        f"Absolute correlation with the true reward, mean over dimensions: {raw:.2f} for the {taken.observation.shape[1]} "
        f"numbers of an observation, {latent:.2f} for the {taken.factors.shape[1]} factors."
    )
    yield from neighbourhoods(taken)
    yield f"<h3>The latent function of {escape(name)}</h3>"
    yield function_text(function.model, function.digest, function.source)


def neighbourhoods(taken: Sample) -> Iterable[str]:
    """The paper's appendix G: t-SNE of observations and of factors, coloured by the true reward."""
    try:
        from sklearn.manifold import TSNE
    except ImportError:
        yield note(f"A t-SNE picture of observations and factors is drawn here after {pip_install('tsne')}.")
        return
    chosen = np.random.default_rng(0).permutation(len(taken.reward))[:PICTURED]

    def plane(columns: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "points 2"]:
        rows = columns[chosen]
        rows = (rows - rows.mean(axis=0)) / np.maximum(rows.std(axis=0), 1e-9)
        return TSNE(init="pca", random_state=0).fit_transform(rows)

    yield figures.scatters(
        {"observations": plane(taken.observation), "factors": plane(taken.factors)}, taken.reward[chosen]
    )
    yield note("t-SNE of steps of agents: similar steps are close together. Colour: the true reward.")
