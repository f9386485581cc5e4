"""How steady a decoder's credit is: fitted anew on the replay of a finished run, compared with the true rewards on the way.

    python benchmarks/refit.py RUN [RUN ...]

For each run (of a method with a decoder, first seed): its own fit as it is, the same with targets left in the units of the
environment, and RRD's biased loss; every 5,000 of 20,000 updates the correlation with the true rewards and the mean error
on the last 5,000 stored steps. And the ceiling: the best linear map of the features to the true rewards of those steps.
"""

import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from measure import write

from lare.credit import accuracy, decomposition
from lare.credit.accuracy import RECENT
from lare.credit.decomposition import Decomposition, Episodes
from lare.credit.methods import Fit
from lare.normalise import Scale
from lare.training import learner as common
from lare.training import replay
from lare.training.credit_draws import CreditDraws, draw_parts_of_episodes
from lare.training.learner import Learner
from lare.training.recipe import Recipe
from lare.training.run import open_run
from lare.training.single_agent import load_learner

UPDATES, STRETCH = 20_000, 5_000


@partial(jax.jit, static_argnames=("fit", "recipe"))
def updates(credit: Decomposition, held: replay.Replay, key: jax.Array, fit: Fit, recipe: Recipe) -> Decomposition:
    def one(credit: Decomposition, drawn: CreditDraws) -> tuple[Decomposition, None]:
        features = common.features(replay.read(held, drawn.steps), recipe.method)
        chosen = drawn.episodes
        episodes = Episodes(features, drawn.episode, chosen.length, chosen.mean_reward, chosen.counts)
        return decomposition.update(credit, episodes, key, fit, recipe.credit)[0], None

    return jax.lax.scan(one, credit, draw_parts_of_episodes(held, key, STRETCH, recipe))[0]


def refit(learner: Learner, recipe: Recipe, fit: Fit, scale: Scale) -> list[dict[str, float]]:
    held, known = learner.replay, learner.credit
    assert known is not None
    recent = replay.read(held, held.transitions - 1 - jnp.arange(RECENT))
    features, every = common.features(recent, recipe.method), jnp.ones(RECENT, bool)
    credit = decomposition.init(jax.random.key(0), recipe.features, recipe.method, recipe.credit, steps=1, agents=1)
    credit = credit._replace(moments=known.moments, scale=scale)
    found = []
    for number in range(UPDATES // STRETCH):
        credit = updates(credit, held, jax.random.key(number), fit, recipe)
        r_hat = decomposition.proxy_rewards(credit, features, recipe.credit)
        found.append(
            {
                "updates": (number + 1) * STRETCH,
                "correlation": float(accuracy.correlation(r_hat, recent.reward, every)),
                "error": float(accuracy.mean_error(r_hat, recent.reward, every)),
            }
        )
    return found


def ceiling(learner: Learner, recipe: Recipe) -> float:
    held = learner.replay
    recent = replay.read(held, held.transitions - 1 - jnp.arange(RECENT))
    rows = np.c_[np.asarray(common.features(recent, recipe.method)), np.ones(RECENT)]
    best = rows @ np.linalg.lstsq(rows, np.asarray(recent.reward), rcond=None)[0]
    return float(np.corrcoef(best, recent.reward)[0, 1])


def main(directories: list[str]) -> None:
    results = {}
    for directory in directories:
        run = open_run(directory)
        recipe, everyone, _, _ = load_learner(run)
        learner = jax.tree.map(lambda leaf: leaf[0], everyone)
        own = learner.scale
        unit = own._replace(mean_square=jnp.ones(()))
        assert recipe.method.fit is not None
        cases = {
            "as it is": (recipe.method.fit, own),
            "targets as they are": (recipe.method.fit, unit),
            "biased": (Fit.DRAWN_STEPS, own),
        }
        found = {name: refit(learner, recipe, *case) for name, case in cases.items()}
        ceilings = [
            ceiling(jax.tree.map(lambda leaf, s=seed: leaf[s], everyone), recipe) for seed in range(len(run.seeds))
        ]
        results[f"{run.config.task.name} {run.config.settings.method}"] = {"ceiling of each seed": ceilings, **found}
        print(f"{directory}: ceiling {', '.join(f'{value:.3f}' for value in ceilings)}")
        for name, steps in found.items():
            print(f"  {name:20s}", "  ".join(f"{at['correlation']:.2f} (error {at['error']:.2f})" for at in steps))
    write("refit", {"results": results})


if __name__ == "__main__":
    main(sys.argv[1:] or sys.exit(__doc__))
