"""The rewards that a `CreditAssigner` gives to steps, by its current decoder."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from lare_rl.assigner import compiled_functions as compiled
from lare_rl.assigner.compiled_functions import on_host, padded, padding
from lare_rl.assigner.decoder_learner import PIECE, Learner
from lare_rl.credit.methods import Reward
from lare_rl.nn.normalise import within_range


def payment(
    learner: Learner,
    features: Float[np.ndarray, "n *agents features"],
    length: Int[np.ndarray, " n"],
    alive: Bool[np.ndarray, "n *agents"] | None = None,
    rows: Int[np.ndarray, " n"] | None = None,
) -> Float[np.ndarray, "n *agents"]:
    """The rewards that the method gives to steps with these features.

    Args:
        learner: holds the decoder, and the store to which `rows` belong.
        features: the decoder's inputs for the steps.
        length: T of each step's episode.
        alive: which agents acted; all by default.
        rows: the places of the steps in the store, for a method that pays by the return of a step's episode.
    """
    config, shape = learner.config, features.shape[:-1]
    match config.method.reward:
        case Reward.DESIGNED:
            found = features[..., 0]
        case Reward.UNIFORM:
            assert rows is not None
            found = np.broadcast_to(uniform(learner, rows).reshape(-1, *[1] * len(config.axis)), shape)
        case _ if learner.fitted:
            starts = range(0, len(features), PIECE)
            parts = [decoded(learner, features[one : one + PIECE], length[one : one + PIECE]) for one in starts]
            found = np.concatenate([np.zeros((0, *shape[1:]), np.float32), *parts])
        case _:
            return np.zeros(shape, np.float32)
    there = np.ones(shape, bool) if alive is None else alive
    if config.method.shared:
        mean = (found * there).sum(axis=-1, keepdims=True) / np.maximum(there.sum(axis=-1, keepdims=True), 1)
        found = np.broadcast_to(mean, shape)
    return np.where(there, found, 0).astype(np.float32)


def uniform(learner: Learner, rows: Int[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """The mean reward of each step's episode, scaled to [0, 1] by the lowest and highest so far; 0.5 before the episode ends."""
    store = learner.store
    with on_host():
        share = np.asarray(within_range(learner.scale, jnp.asarray(store.mean_reward[rows])))
    return np.where(store.length[rows] > 0, share, 0.5)


def decoded(
    learner: Learner, features: Float[np.ndarray, "n *agents features"], length: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n *agents"]:
    """The decoder's rewards."""
    config, size, flat = learner.config, padding(len(features)), learner.paying
    long = padded(length, size)
    long[len(length) :] = 1
    with on_host():
        of_method = flat.structure, config.method.name, config.settings
        found = compiled.rewards(flat.leaves, padded(features, size), long, *of_method)
        found = compiled.divided(found, learner.scale) if config.scale_rewards else found
        return np.asarray(found)[: len(features)]
