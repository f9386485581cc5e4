"""What the stored returns of a run say about its factors, whatever decoder it trains with."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import jax
import numpy as np
from jaxtyping import Array, Bool

from lare_rl.credit import closed_form, decomposition, returns
from lare_rl.credit.closed_form import LinearDecoder
from lare_rl.credit.decomposition import Episodes
from lare_rl.credit.explanation import Explanation, Steps, add_steps, explain, no_steps
from lare_rl.credit.explanation_text import FEWEST, entry_names, words
from lare_rl.credit.methods import METHODS, Decoder
from lare_rl.data.replay import Replay
from lare_rl.runs.directory import Run
from lare_rl.training.episodes import from_stored, pieces
from lare_rl.training.learner import Learner, init_credit
from lare_rl.training.seed_axis import of_seed
from lare_rl.training.session import load_learner
from lare_rl.training.static_config import TrainConfig
from lare_rl.util.float64 import float64


def judging(config: TrainConfig) -> TrainConfig:
    """The run's configuration, with a closed-form fit that explains its returns from the columns of its replay."""
    shown = "state" if config.of_state else "observation"
    raw = {shown, "action"} <= set(config.columns)
    if not config.method.latent:
        method = METHODS["bayes"]
        return replace(config, method=method if raw else replace(method, encoder=config.method.encoder))
    method = METHODS["lare-bayes"] if raw else replace(METHODS["lare-linear"], decoder=Decoder.ADDITIVE)
    return replace(config, method=method)


def explanations(learner: Learner, config: TrainConfig) -> list[Explanation]:
    """Explanations of the first seed's stored episodes, one for each team.

    Empty for a method that fits nothing to returns, and for too few episodes.
    """
    chosen, held = judging(config), learner.replay
    known = learner.credit and all(basis.size for basis in chosen.bases)
    if not known or np.sum(np.asarray(held.episodes)[0] - np.asarray(held.oldest)[0]) < FEWEST:
        return []
    with float64():
        found = explaining(chosen)(held, tuple(credit.average for credit in learner.credit))
        return [jax.tree.map(np.asarray, each) for each in found]


def explaining(config: TrainConfig) -> Callable[..., list[Explanation]]:
    """`explain_stored`, compiled."""
    return jax.jit(partial(explain_stored, config=config))


def explain_stored(
    replay: Replay, averages: tuple[Bool[Array, " seeds"], ...], config: TrainConfig
) -> list[Explanation]:
    """Explanations from all finished episodes of the first seed."""
    buffer, average = of_seed((replay, averages))
    credit = from_stored(init_credit([jax.random.key(0)] * len(average), config), buffer, config)
    closed = [one.closed for one in credit if one.closed is not None]

    def take(
        carried: tuple[LinearDecoder, Steps], episodes: Episodes, there: Bool[Array, " episodes"]
    ) -> tuple[LinearDecoder, Steps]:
        decoder, steps = carried
        rows = decomposition.counted_rows(episodes, there)
        return decoder, add_steps(steps, decoder.features(episodes.features), rows, decoder.basis)

    empty = tuple((one.decoder, no_steps(one.decoder.basis)) for one in closed)
    summed = pieces(empty, buffer, buffer.oldest, take, config)
    return [
        explain(closed_form.whole(one.summed), steps, form.astype(int), one.decoder.basis)
        for one, (_, steps), form in zip(closed, summed, average, strict=True)
    ]


def described(run: Run, learner: Learner, config: TrainConfig) -> list[str]:
    """The explanations of the returns of a run's first seed, in sentences."""
    lines: list[str] = []
    roles = run.config.task.roles
    for place, found in enumerate(explanations(learner, config)):
        function = run.functions[place] if run.functions else None
        factors = [] if function is None else function.columns_by(run.judges)
        form = returns.form_found(of_seed(learner.credit[place]))
        role = roles[place]
        entries = (
            []
            if config.of_state
            else entry_names(role.observation, role.action, len(found.left), role.action_size, config.judges == "both")
        )
        team = f"{config.env.teams[place].name}: " if len(roles) > 1 else ""
        lines += [team + line for line in words(found, form, factors, entries)]
    about = [f"of seed {run.seeds[0]} alone"] if len(run.seeds) > 1 else []
    if config.method.descends:
        about.append(f"by a closed-form fit to the stored returns, which is not the decoder of {config.method.name}")
    if lines and about:
        head = ", ".join(about)
        lines.insert(0, f"{head[0].upper()}{head[1:]}:")
    return lines


def explanation_of(run: Run) -> list[str]:
    """`described` for a run's last checkpoint."""
    config, learner, _, _ = load_learner(run)
    return described(run, learner, config)
