"""In words: how well returns can be told from the factors, which factors matter, and what may be missing."""

import re
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from lare.credit import closed_form, decomposition, returns
from lare.credit.decomposition import Decomposition, Episodes
from lare.credit.explanation import Explanation, explain
from lare.credit.methods import METHODS, Decoder
from lare.data.replay import Replay
from lare.run.directory import Run
from lare.tasks.spec import TaskSpec
from lare.training.config import TrainConfig
from lare.training.episodes import pieces, sum_again
from lare.training.learner import Learner, init_credit
from lare.training.seeds import of_seed
from lare.training.session import load_learner

FEWEST = 20
"""Episodes, below which nothing is said."""
NEXT_TO_NOTHING = 0.1
"""Of the variation of the returns."""
STRIKING = 0.3
"""A correlation with what the factors leave."""
FORMS = ("sum", "average")
"""Of a score, by number."""


def judging(config: TrainConfig) -> TrainConfig:
    """The run's configuration, with the fit in closed form that explains its returns from what its replay holds."""
    shown = "state" if config.of_state else "observation"
    raw = {shown, "action"} <= set(config.columns)
    if not config.method.latent:
        method = METHODS["bayes"]
        return replace(config, method=method if raw else replace(method, encoder=config.method.encoder))
    method = METHODS["lare-bayes"] if raw else replace(METHODS["lare-linear"], decoder=Decoder.ADDITIVE)
    return replace(config, method=method)


def explanations(learner: Learner, config: TrainConfig) -> list[Explanation]:
    """Of the first seed's stored episodes, for each team. Empty for a method that fits nothing to returns, and for few episodes."""
    one = of_seed(learner)
    if not learner.credit or int(jnp.sum(one.replay.episodes - one.replay.oldest)) < FEWEST:
        return []
    with jax.enable_x64(True):
        found = jax.jit(partial(explain_stored, config=judging(config)))(
            one.replay, tuple(credit.average for credit in one.credit)
        )
        return [jax.tree.map(np.asarray, each) for each in found]


def explain_stored(buffer: Replay, average: tuple[Bool[Array, ""], ...], config: TrainConfig) -> list[Explanation]:
    """By all finished episodes of a replay."""
    untrained = init_credit([jax.random.key(0)] * len(average), config)

    def observe(one: Decomposition, episodes: Episodes, there: Bool[Array, " episodes"]) -> Decomposition:
        count = len(episodes.length)
        known = (episodes.episode < count) & there[jnp.minimum(episodes.episode, count - 1)]
        mask = known[:, None] & (
            jnp.ones(episodes.features.shape[:2], bool) if episodes.share is None else episodes.share > 0
        )
        return decomposition.observe_steps(one, episodes.features, mask)

    credit = pieces(untrained, buffer, buffer.oldest, observe, config)
    credit = sum_again(credit, buffer, jnp.array(True), config)
    found = []
    for one, form, basis in zip(credit, average, config.bases, strict=True):
        assert one.closed is not None
        found.append(explain(closed_form.whole(one.closed.summed), form.astype(int), basis))
    return found


def entry_names(spec: TaskSpec, entries: int) -> list[str]:
    """What the task's text calls the entries of [s', a]: `7: angle of the foot` names entry 7."""

    def named(text: str, count: int, kind: str) -> list[str]:
        lines = dict(re.findall(r"^[\s\-*\[]*(\d+)\]?\s*[:.)]\s*(.+)$", text, flags=re.MULTILINE))
        return [
            f"entry {i} of the {kind}" + (f" ({lines[str(i)].strip()})" if str(i) in lines else "")
            for i in range(count)
        ]

    shown = max(0, entries - spec.action_size)
    return named(spec.observation, shown, "observation") + named(spec.action, entries - shown, "action")


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
            "What goes with each factor: its share of the variation, and what a step pays more for one standard deviation of it:"
        )
        said += [
            f"- {factors[i]}: {max(0, found.share[i]):.0%}, {found.weight[i]:+.3g} ± {found.deviation[i]:.1g}"
            for i in np.argsort(-found.share, kind="stable")
        ]
    if entries and found.by_factors < 0.95 and np.abs(found.left).max() > STRIKING:
        place = int(np.argmax(np.abs(found.left)))
        way = "large" if found.left[place] > 0 else "small"
        said.append(
            f"Returns are higher than the factors predict when {entries[place]} is {way} "
            f"(correlation {found.left[place]:+.2f}): a factor may be missing."
        )
    return said


def described(run: Run, learner: Learner, config: TrainConfig) -> list[str]:
    """What is to be said of a run's returns, of its first seed."""
    lines, basis = [], judging(config).bases
    roles = run.config.task.roles
    for place, found in enumerate(explanations(learner, config)):
        function = run.functions[place] if run.functions else None
        factors = [] if function is None else function.columns_by(run.judges)
        form = returns.form_found(of_seed(learner.credit[place]))
        entries = entry_names(roles[place], basis[place].entries) if len(found.left) and not config.of_state else []
        team = f"{config.env.teams[place].name}: " if len(roles) > 1 else ""
        lines += [team + line for line in words(found, form, factors, entries)]
    return lines


def explanation_of(run: Run) -> list[str]:
    """The same of a run's last checkpoint."""
    config, learner, _, _ = load_learner(run)
    return described(run, learner, config)
