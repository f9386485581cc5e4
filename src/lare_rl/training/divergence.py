"""Stops a training whose actions or losses are not finite any more."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from lare_rl.errors import LareError

__all__ = ["DivergedError", "check_actions", "check_losses"]

REMEDY = "train again with a smaller learning rate; the last checkpoint is intact"


class DivergedError(LareError):
    """A policy or a loss is not finite any more."""


def check_actions(action: Float[np.ndarray, "seeds *rest"], seeds: Sequence[int]) -> None:
    """Raise `DivergedError` if the actions of a seed's policy are not finite. Discrete ones always are: `check_losses` finds the error."""
    for seed, action_of_seed in zip(seeds, action, strict=True):
        if not np.isfinite(action_of_seed).all():
            raise DivergedError(f"training diverged: the policy of seed {seed} is not finite any more; {REMEDY}")


def check_losses(metrics: Mapping[str, Any], seeds: Sequence[int], step: int) -> None:
    """Raise `DivergedError` if a loss of a seed that has made updates is not finite. The metrics are arrays with a number for each seed."""
    # Only QMIX and VDN count updates. The loss of a seed without updates is NaN.
    updates = np.asarray(metrics.get("algorithm/updates", np.ones(len(seeds))))
    for name in metrics:
        if not name.startswith(("critic/loss", "credit/loss")):
            continue
        for seed, loss, n_updates in zip(seeds, np.asarray(metrics[name]), updates, strict=True):
            if n_updates and not np.isfinite(loss):
                raise DivergedError(
                    f"training diverged, or a JaxEnv returned NaN: {name} of seed {seed} is not finite at step {step}; {REMEDY}"
                )
