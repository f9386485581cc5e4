"""Table 1 of the paper: correlations of states and factors with the true reward, and how many replies pass without correction."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lare_rl.envs.load import load_task
from lare_rl.envs.play import Episode, play_episodes
from lare_rl.latent.design import DesignError, design, examine_reply
from lare_rl.latent.function import LatentFunction
from lare_rl.llm.recording import shipped_recordings
from lare_rl.tasks.spec import ScoredObservation, TaskSpec
from lare_rl.util.statistics import column_correlations
from paper.exhibits import Budget
from paper.pages import Page, items, table

TITLE = "What states and factors know of the true reward"
PRINTED = {
    "CN-6": ("0.02 (26)", "0.50 (5.6)", "0%", "100%"),
    "PP-6": ("0.01 (28)", "0.12 (5.4)", "20%", "100%"),
    "HalfCheetah-v4": ("0.22 (17)", "0.53 (4.8)", "40%", "100%"),
    "HumanoidStandup-v4": ("0.20 (376)", "0.49 (5.6)", "40%", "100%"),
}
"""The paper's figures."""

DIFFERENCES = (
    "The steps are of uniformly random actions, for states and factors alike; the paper does not say which policy it used.",
    "States and factors are those after a step, the rewards those of the step; with many agents, each agent's own.",
    "The mean is over the absolute correlations of all entries that vary; the paper does not say whether its correlations are "
    "absolute. So a state with a few informative entries among many has a low mean; the best entry tells more about what a decoder "
    "could find.",
    "The recorded replies are of a newer language model than the paper's, and the prompt says more.",
)


class Steps(NamedTuple):
    """Steps of one agent at a time."""

    before: Float[np.ndarray, "steps observation"]
    action: Float[np.ndarray, "steps action"]
    after: Float[np.ndarray, "steps observation"]
    reward: Float[np.ndarray, " steps"]
    """True rewards."""


def make_page(budget: Budget, command: str) -> Page:
    """Measure, and make a page with the results beside the paper's figures."""
    rows = []
    for task in map(load_task, PRINTED):
        functions = designed(task, budget.functions)
        passed = [function for function in functions if function is not None]
        entries = entries_cells(random_steps(task, budget.episodes), task.scored_observation, passed)
        alone = replies_cell(task, budget.functions)
        rows.append([task.name, *entries, alone, f"{len(passed)} of {len(functions)}"])
    head = (
        "",
        "states: correlation (entries), best",
        "factors: correlation (number), best",
        "replies that pass as they come",
        "functions that pass after verification",
    )
    sections = [
        f"# {TITLE}",
        f"The paper's table 1, by `{command}`: {budget.episodes} episodes of random actions, {budget.functions} of the "
        "recorded draws of the language model. Absolute correlation (Pearson's) of an entry with the true reward of the same "
        "step: mean over the entries, and the best one; of factors the mean over the draws.",
        table(head, rows),
        "## What the paper says",
        table(
            ("", "states", "factors", "without pre-verification", "with"),
            ([name, *printed] for name, printed in PRINTED.items()),
        ),
        "## What differs from the paper",
        items(DIFFERENCES),
    ]
    return Page("table-1", "\n\n".join(sections))


def designed(task: TaskSpec, draws: int) -> list[LatentFunction | None]:
    """The function of each draw; None if no attempt passed."""
    functions: list[LatentFunction | None] = []
    for draw in range(draws):
        try:
            functions.append(design(task, draw=draw))
        except DesignError:
            functions.append(None)
    return functions


def entries_cells(
    steps: Steps, scored_observation: ScoredObservation, functions: Sequence[LatentFunction]
) -> tuple[str, str]:
    """Correlations of states, and of the factors of each function."""
    state = np.abs(column_correlations(steps.after, steps.reward))
    state_cell = f"{np.nanmean(state):.2f} ({len(state)}), {np.nanmax(state):.2f}"
    if not functions:
        return state_cell, "-"
    correlations = [
        np.abs(
            column_correlations(
                function.step_factors(steps.before, steps.action, steps.after, scored_observation), steps.reward
            )
        )
        for function in functions
    ]
    mean, size, best = (
        np.mean([float(measure(entry)) for entry in correlations]) for measure in (np.nanmean, len, np.nanmax)
    )
    return state_cell, f"{mean:.2f} ({size:.1f}), {best:.2f}"


def replies_cell(task: TaskSpec, draws: int) -> str:
    """The share of single candidates that pass without correction."""
    recordings = [entry for draw in range(draws) for entry in shipped_recordings("factors", draw)]
    exchanges = [exchange for entry in recordings if entry.task == task.name for exchange in entry.exchanges]
    replies = [reply for exchange in exchanges if exchange.stage == "candidate" for reply in exchange.replies]
    passed = [examine_reply(reply, task, "factors").verdict.passed for reply in replies]
    return f"{sum(passed)} of {len(passed)}"


def random_steps(task: TaskSpec, episodes: int) -> Steps:
    """Whole episodes of uniformly random actions, with the rows of all agents one after the other."""
    played = play_episodes(task, episodes)

    def rows(read_values: Callable[[Episode], np.ndarray]) -> np.ndarray:
        return np.concatenate([read_values(entry)[entry.alive] for entry in played])

    return Steps(
        rows(lambda entry: entry.observation),
        rows(lambda entry: entry.env_action),
        rows(lambda entry: entry.next_observation),
        rows(lambda entry: entry.reward),
    )
