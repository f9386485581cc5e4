"""Random numbers that are a function of seed, purpose and the number of a step or episode, so that there is no state to save."""

from collections.abc import Sequence
from enum import IntEnum
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from lare_rl.algorithms.registry import Noise

__all__ = [
    "Stream",
    "device_noise",
    "episode_seed",
    "host_noise",
    "keys_shape",
    "numpy_generator",
    "seed_keys",
    "stream_keys",
]


class Stream(IntEnum):
    """The purposes of random numbers. The streams are independent of each other."""

    TRAINING_EPISODES = 0
    EXPLORATION = 1
    EVALUATION_EPISODES = 2
    FIT = 3
    EVALUATION_NOISE = 4


def numpy_generator(seed: int, stream: Stream, number: int) -> np.random.Generator:
    """Return a generator for the host."""
    return np.random.default_rng([seed, stream, number])


def episode_seed(seed: int, stream: Stream, episode: int) -> int:
    """Return the seed with which an environment on the host is reset."""
    return int(numpy_generator(seed, stream, episode).integers(2**31))


@jax.jit
def seed_keys(seeds: Int[Array, " seeds"], number: int | Array) -> Key[Array, " seeds"]:
    """Return a key for each seed, by a number. The keys of purposes have negative numbers (`stream_keys`)."""
    return jax.vmap(lambda seed: jax.random.fold_in(jax.random.key(seed), number))(seeds)


def keys_shape(n_seeds: int) -> Any:
    """Return keys of all seeds, with a shape instead of an array."""
    return jax.eval_shape(seed_keys, jnp.zeros(n_seeds, int), 0)


def stream_keys(
    seeds: Sequence[int] | Int[Array, " seeds"], stream: Stream, number: int | Int[Array, ""]
) -> Key[Array, " seeds"]:
    """Return a key for each seed, by a purpose and a number."""
    streams = seed_keys(jnp.asarray(seeds), -1 - int(stream))
    return jax.vmap(lambda key: jax.random.fold_in(key, number))(streams)


def host_noise(rng: np.random.Generator, noise: Noise, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """Draw noise for a policy that collects on the host."""
    uniform = partial(rng.random, dtype=np.float32)
    draw = {Noise.NORMAL: rng.standard_normal, Noise.GUMBEL: rng.gumbel, Noise.UNIFORM: uniform}[noise]
    return draw(size=shape).astype(np.float32)


def device_noise(key: Array, noise: Noise, shape: tuple[int, ...]) -> Float[Array, "..."]:
    """Draw the noise of `host_noise` in compiled code."""
    draw = {Noise.NORMAL: jax.random.normal, Noise.GUMBEL: jax.random.gumbel, Noise.UNIFORM: jax.random.uniform}[noise]
    return draw(key, shape)
