"""The policy of each seed's best evaluation, saved next to the last checkpoint.

    checkpoint/best.npz     the arrays that are needed to act; return and step of each seed

The best of many evaluations overestimates its policy. So `lare-rl evaluate --best` begins in other initial states.
"""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from lare_rl.errors import LareError
from lare_rl.runs.checkpoint import fill_template, named_leaves
from lare_rl.util.files import make_directory, remove_partial_files, replace_npz
from lare_rl.util.npz import open_npz, report_damage

__all__ = ["BEST_FILE", "BestPolicy", "empty_best", "load_best", "save_best", "update_best"]

BEST_FILE = "best.npz"


class BestPolicy(NamedTuple):
    """The policy of each seed's best evaluation."""

    return_: Float[np.ndarray, " seeds"]
    """The mean return of the best evaluation; -inf before the first."""
    step: Int[np.ndarray, " seeds"]
    """The environment step of that evaluation."""
    actor: Any
    """What acted in that evaluation; None before the first."""


def empty_best(n_seeds: int) -> BestPolicy:
    """Return the state before the first evaluation."""
    return BestPolicy(np.full(n_seeds, -np.inf), np.zeros(n_seeds, np.int64), None)


def update_best(best: BestPolicy, return_: Float[np.ndarray, " seeds"], step: int, actor: Any) -> BestPolicy:
    """Replace the policy of each seed whose return exceeds its best. NaN never does."""
    is_better = np.asarray(return_) > best.return_

    def choose(old: Any, new: Any) -> np.ndarray:
        return np.where(is_better.reshape(-1, *[1] * (old.ndim - 1)), np.asarray(new), np.asarray(old))

    old_actor = actor if best.actor is None else best.actor
    return BestPolicy(
        return_=np.where(is_better, return_, best.return_),
        step=np.where(is_better, step, best.step),
        actor=jax.tree.map(choose, old_actor, actor),
    )


def save_best(directory: Path, best: BestPolicy) -> None:
    """Write the best policies into a checkpoint's directory. Raises `LareError` if they cannot be written."""
    make_directory(directory)
    remove_partial_files(directory / BEST_FILE)
    replace_npz(directory / BEST_FILE, named_leaves(best))


def load_best(directory: Path, actor_shape: Any, n_seeds: int) -> BestPolicy:
    """Read the best policies from a checkpoint's directory. `actor_shape` is an actor, whose leaves may be shapes.

    Raises `LareError` if there is no such file, or it has another structure.
    """
    path = directory / BEST_FILE
    if not path.is_file():
        raise LareError(
            f"there is no {path}: the run has not been evaluated yet, trains several teams, or is of an older version"
        )
    with report_damage(f"{path} cannot be read"), open_npz(path) as arrays:
        return fill_template(empty_best(n_seeds)._replace(actor=actor_shape), arrays)
