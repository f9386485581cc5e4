"""The scripted prey of predator and prey: a small policy network that ships with the package.

logits = W_3 relu(W_2 relu(W_1 observation)), and an action is drawn from their softmax. `benchmarks/train_prey.py` trained it.
"""

from functools import cache
from importlib.resources import files

import jax
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

__all__ = ["Layers", "logits", "sample_actions", "shipped_prey"]

Layers = tuple[tuple[Float[np.ndarray | Array, "_in _out"], Float[np.ndarray | Array, " _out"]], ...]
"""Weight and bias of each layer."""


@cache
def shipped_prey() -> Layers:
    """Load the prey's network, which is the same for PP-6, PP-15 and PP-30."""
    with files("lare_rl.envs.particles").joinpath("prey.npz").open("rb") as file, np.load(file) as arrays:
        return tuple((arrays[f"weight_{i}"], arrays[f"bias_{i}"]) for i in range(len(arrays) // 2))


def logits(layers: Layers, observation: Float[Array, "preys observation"]) -> Float[Array, "preys actions"]:
    *hidden, (weight, bias) = layers
    for hidden_weight, hidden_bias in hidden:
        observation = jax.nn.relu(observation @ hidden_weight + hidden_bias)
    return observation @ weight + bias


def sample_actions(
    layers: Layers, observation: Float[Array, "preys observation"], key: PRNGKeyArray
) -> Int[Array, " preys"]:
    """Sample an action of each prey from the softmax of its logits."""
    return jax.random.categorical(key, logits(layers, observation))
