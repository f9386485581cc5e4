"""How far the policies of an off-policy algorithm choose the same bounds of the actions in all states."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from lare_rl.data.replay import Replay, capacity
from lare_rl.training.static_config import TrainConfig

__all__ = ["greedy_actions", "measure", "saturation"]

N_STATES = 1000
"""The number of stored observations of an environment in which a policy acts."""
ACTION_BOUND = 0.99
"""A component of a normalised action is at a bound if its size is larger."""


def measure(act: Callable[..., Any], actor: Any, replay: Replay, config: TrainConfig) -> Float[np.ndarray, " seeds"]:
    """Return the saturation of each seed's policy in the newest states of its first environment.

    `act` and `actor` are as in `compiled.CompiledFunctions`.
    """
    return saturation(greedy_actions(act, actor, replay, config, N_STATES))


def greedy_actions(
    act: Callable[..., Any], actor: Any, replay: Replay, config: TrainConfig, n_states: int
) -> Float[np.ndarray, "seeds states action"]:
    """Return actions without noise in the newest states of the first environment.

    If fewer are stored, they are repeated: the shape, and so the compiled program, is always the same.
    """
    rows = np.asarray(replay.next_row)[:, :1] - 1 - np.arange(n_states) % int(np.min(replay.next_row))
    observation = _read_first_env(replay.columns["observation"], rows % capacity(replay))
    available = np.ones((*rows.shape, 1, config.env.action_size), bool)
    action, _ = act(actor, (), observation, available, None, np.zeros(rows.shape, bool))
    return np.asarray(action)[:, :, 0]


def saturation(action: Float[np.ndarray, "seeds steps action"]) -> Float[np.ndarray, " seeds"]:
    """Return the fraction of an action's components that are at the same bound in all states.

    Each seed's policy has chosen the actions in the same states, without noise, between -1 and 1.
    """
    bound = np.where(np.abs(action) > ACTION_BOUND, np.sign(action), 0)
    return np.mean((bound[:, 0] != 0) & np.all(bound == bound[:, :1], axis=1), axis=-1)


@jax.jit
def _read_first_env(
    column: Shaped[Array, "seeds envs rows *rest"], rows: Int[Array, "seeds steps"]
) -> Shaped[Array, "seeds steps *rest"]:
    """Return rows of a column of the replay, of each seed's first environment."""
    return jax.vmap(lambda seed_column, seed_rows: seed_column[0, seed_rows])(column, rows)
