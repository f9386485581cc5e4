"""The sections of a report that only runs of many agents have."""

from collections.abc import Iterable
from html import escape

import numpy as np
from jaxtyping import Float

from lare_rl.errors import install_command
from lare_rl.evaluation.episode_credit import label_factors
from lare_rl.evaluation.rollout import roll_out
from lare_rl.evaluation.team_samples import TeamSample, sample_steps
from lare_rl.evaluation.video import encode_gif, render_rollout
from lare_rl.report.figures import draw_credit_map, draw_scatters
from lare_rl.report.html import render_factor_table, render_function, render_gif, render_note
from lare_rl.runs.directory import Run
from lare_rl.util.statistics import column_correlations

__all__ = ["render_agents"]

MAX_TSNE_POINTS = 1000


def render_agents(run: Run) -> Iterable[str]:
    """Yield the credit of each agent and step, a film of the episode, and the factors of each team."""
    rollout = roll_out(run)
    reward, proxy_reward = rollout.select_episode((rollout.reward, rollout.proxy_reward))
    sums = f"Sum of the true rewards {reward.sum():.1f}"
    if proxy_reward is not None:
        sums += f", of the proxy rewards {proxy_reward.sum():.1f}"
    yield "<h3>Who got which credit when</h3>"
    yield draw_credit_map(reward, proxy_reward)
    yield render_note(
        f"One episode of the first seed's policy, every agent a row. {sums}. A film shows the credit beside each agent as "
        "number and colour: blue for more, red for less."
    )
    if (frames := render_rollout(run, rollout)) is not None:
        yield render_gif(encode_gif(frames), "one episode, with the credit of each agent")
    if run.functions:
        for team_index, sample in enumerate(sample_steps(run)):
            yield from _render_team(run, team_index, sample)


def _render_team(run: Run, team_index: int, sample: TeamSample) -> Iterable[str]:
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
    yield from _render_tsne(sample)
    yield f"<h3>The latent function of {name}</h3>"
    yield render_function(run.functions[team_index])


def _render_tsne(sample: TeamSample) -> Iterable[str]:
    """Yield t-SNE pictures of observations and of factors, coloured by the true reward (the paper's appendix G)."""
    try:
        from sklearn.manifold import TSNE
    except ImportError:
        yield render_note(f"A t-SNE picture of observations and factors is drawn here after {install_command('tsne')}.")
        return
    points = np.random.default_rng(0).permutation(len(sample.reward))[:MAX_TSNE_POINTS]

    def embed(columns: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "points 2"]:
        rows = columns[points]
        rows = (rows - rows.mean(axis=0)) / np.maximum(rows.std(axis=0), 1e-9)
        return TSNE(init="pca", random_state=0).fit_transform(rows)

    embeddings = {"observations": embed(sample.next_observation), "factors": embed(sample.factors)}
    yield draw_scatters(embeddings, sample.reward[points])
    yield render_note("t-SNE of steps of agents: similar steps are close together. Colour: the true reward.")
