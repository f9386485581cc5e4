"""The features of a step, in groups. A closed-form decoder is linear in these features.

With u = (x - mean) / deviation over all steps, where x is one of the factors z or of the raw entries of a step:

    factors             u_i
    shapes of factors   cos(k pi u_i / 4) / k,  sin(k pi u_i / 4) / k,   k = 1, 2, 3
    pairs of factors    u_i u_j,  i < j
    entries             u_i
    shapes of entries   as those of the factors
    pairs of entries    as those of the factors, if there are at most 12 entries

Shapes are the first terms of the Fourier series of a function of one number, within four standard deviations of its mean.
They can express "more is better up to this value", "near this value" or "beyond this value". Pairs express interactions of
two factors or entries: price times power. The returns decide which groups are needed (`evidence.py`).

The raw entries are those of the state by which the task judges a step, and of the action: [s', a], [s, a], or [s, s', a]. The
published s - s' would carry almost no information: its mean over an episode is close to zero, because the differences cancel.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

FREQUENCIES = 3
HALF_PERIOD = 4.0
"""In standard deviations. Shapes are constant beyond this distance from the mean."""
LARGEST = 512
"""Limit on the number of features. If the shapes of the entries would exceed it, entries get fewer frequencies, or none."""
MOST_PAIRED = 12
"""With more raw entries, there are no pairs of them: their number grows with the square of that of the entries."""
MOST_ENTRIES = 1024
"""Limit on the number of raw entries. If there are more (images, for example), none is used: the time of a fit grows with the
cube of the number of features."""


@dataclass(frozen=True)
class Basis:
    """The set of features. An input row has the factors and then the raw entries, or only the parts that the method uses."""

    factors: int
    entries: int
    extended: bool
    """Whether shapes and pairs are added to the inputs."""

    @property
    def inputs(self) -> int:
        """The size of an input row."""
        return self.factors + self.entries

    @property
    def sizes(self) -> dict[str, int]:
        """The number of features in each group that is not empty, in order."""
        sizes = {"factors": self.factors}
        if self.extended:
            sizes |= {"shapes of factors": 2 * FREQUENCIES * self.factors, "pairs of factors": pairs_of(self.factors)}
        sizes["entries"] = self.used_entries
        if self.extended:
            sizes["shapes of entries"] = 2 * self.frequencies_of_entries * self.used_entries
            sizes["pairs of entries"] = pairs_of(self.paired_entries)
        return {name: size for name, size in sizes.items() if size}

    @property
    def used_entries(self) -> int:
        """How many of the entries are features: all or none."""
        return self.entries if self.entries <= MOST_ENTRIES else 0

    @property
    def paired_entries(self) -> int:
        """How many of the entries are in pairs: all or none."""
        return self.entries if self.entries <= MOST_PAIRED else 0

    @property
    def frequencies_of_entries(self) -> int:
        """The number of frequencies for each entry."""
        factors = self.factors * (1 + 2 * FREQUENCIES) + pairs_of(self.factors)
        left = max(0, LARGEST - factors - self.entries)
        return min(FREQUENCIES, left // max(1, 2 * self.entries))

    @property
    def size(self) -> int:
        """The total number of features."""
        return sum(self.sizes.values())

    @property
    def group(self) -> Int[np.ndarray, " features"]:
        """The index of each feature's group."""
        return np.repeat(np.arange(len(self.sizes)), list(self.sizes.values()))

    @property
    def of_factors(self) -> Bool[np.ndarray, " features"]:
        """Which features are made of factors alone."""
        return np.repeat(["factors" in name for name in self.sizes], list(self.sizes.values()))


def pairs_of(inputs: int) -> int:
    """The number of pairs of different inputs."""
    return inputs * (inputs - 1) // 2


def pairs(u: Float[Array, "*batch inputs"]) -> Float[Array, "*batch features"]:
    """u_i u_j for i < j, each within four deviations."""
    one, other = np.triu_indices(u.shape[-1], 1)
    within = jnp.clip(u, -HALF_PERIOD, HALF_PERIOD)
    return within[..., one] * within[..., other]


def shapes(u: Float[Array, "*batch inputs"], frequencies: int) -> Float[Array, "*batch features"]:
    """The terms of the Fourier series by frequency. Within a frequency, the cosines of all inputs precede their sines.

    Only the first frequency is computed directly: cos (k + 1) a = 2 cos a cos k a - cos (k - 1) a, and likewise for sines.
    """
    waves = cosine_and_sine(jnp.pi / HALF_PERIOD * jnp.clip(u, -HALF_PERIOD, HALF_PERIOD))
    before, twice, terms = (jnp.ones_like(u), jnp.zeros_like(u)), 2 * waves[0], [u[..., :0]]
    for k in range(1, frequencies + 1):
        terms += [wave / k for wave in waves]
        before, waves = waves, tuple(twice * wave - last for wave, last in zip(waves, before, strict=True))
    return jnp.concatenate(terms, axis=-1)


def cosine_and_sine(angle: Float[Array, "*batch"]) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Cosine and sine of angles between -pi and pi, to the precision of float32, by the Taylor series at half of each angle.

    XLA's own functions accept any angle but take fifteen times as long, which would be most of the time of a fit.
    """
    half = angle / 2
    square, cosine, sine = half**2, 1.0, 1.0
    for n in range(11, 0, -2):
        cosine = 1 - square / (n * (n + 1)) * cosine
        sine = 1 - square / ((n + 1) * (n + 2)) * sine
    sine = half * sine
    return cosine**2 - sine**2, 2 * sine * cosine


def expand(basis: Basis, u: Float[Array, "*batch inputs"]) -> Float[Array, "*batch features"]:
    """The features of standardised inputs."""
    factors, entries = u[..., : basis.factors], u[..., basis.factors : basis.factors + basis.used_entries]
    if not basis.extended:
        return jnp.concatenate([factors, entries], axis=-1)
    return jnp.concatenate(
        [
            factors,
            shapes(factors, FREQUENCIES),
            pairs(factors),
            entries,
            shapes(entries, basis.frequencies_of_entries),
            pairs(entries[..., : basis.paired_entries]),
        ],
        axis=-1,
    )
