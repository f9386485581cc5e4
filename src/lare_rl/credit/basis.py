"""The features of a step, in groups. A closed-form decoder is linear in these features.

With u = (x - mean) / std over all steps, where x is a factor or a raw feature:

    factors                  u_i
    shapes of factors        cos(k pi u_i / 4) / k,  sin(k pi u_i / 4) / k,   k = 1, 2, 3
    pairs of factors         u_i u_j,  i < j
    raw features             u_i
    shapes of raw features   as those of the factors
    pairs of raw features    as those of the factors, if there are at most 12 raw features

    extremes of factors      h(M) - h(M'),  M = max of u_i up to the step, M' before it;  minima and last values likewise (`history.py`)

If the history of the episode is an input, largest, smallest and last values have a group each for h(M) = M, and one for h = the shapes
of M. Without factors, the raw features are tracked instead.

Shapes are the first terms of the Fourier series of a function of one number, within four standard deviations of its mean.
They can express "more is better up to this value", "near this value" or "beyond this value". Pairs express interactions, such as
price times power. The returns decide which groups are needed (`evidence.py`).

The raw features are the entries of the states that the factors are computed from, and of the action: [s', a], [s, a], or
[s, s', a]. The published s - s' would carry almost no information: the differences of an episode cancel, so its mean is close to 0.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lare_rl.credit.history import next_history
from lare_rl.credit.input_names import N_EXTREMES

__all__ = [
    "MAX_PAIRED_RAW_FEATURES",
    "MAX_RAW_FEATURES",
    "Basis",
    "expand",
    "expand_history",
    "fourier_terms",
    "pair_products",
]

N_FREQUENCIES = 3
"""The number of frequencies of a shape."""
HALF_PERIOD = 4.0
"""Shapes are constant beyond this number of standard deviations from the mean."""
MAX_FEATURES = 512
"""If there would be more features, shapes of raw features have fewer frequencies, or none. Pairs of raw features and histories do not
count."""
MAX_HISTORY_FEATURES = 192
"""The maximum number of shapes of largest, smallest and last values."""
MAX_PAIRED_RAW_FEATURES = 12
"""With more raw features, there are no pairs of them, because the number of pairs grows with the square."""
MAX_RAW_FEATURES = 1024
"""If there are more raw features (images, for example), none is used: the time of a fit grows with the cube of their number."""


@dataclass(frozen=True)
class Basis:
    """The feature map of an input row, which has the factors and then the raw features. Either may be absent."""

    n_factors: int
    n_raw: int
    extended: bool
    """Whether shapes and pairs are added to the inputs."""
    n_tracked: int = 0
    """The number of first inputs whose history follows them in a row: all factors or, without factors, all raw features."""
    n_levels: int = 0
    """The number of levels that episodes may belong to. Each has an intercept (`closed_form.py`)."""
    prefixes: bool = False
    """Whether returns are fitted to prefixes of episodes. The number of steps so far then has a weight too."""
    start_value: bool = False
    """Whether a sum may have a start value: the weight of 1/T in a fit of R/T (`closed_form.py`)."""

    @property
    def n_inputs(self) -> int:
        """The size of an input row."""
        return self.n_standardised + N_EXTREMES * self.n_tracked

    @property
    def n_standardised(self) -> int:
        """The number of inputs of a row without its history."""
        return self.n_factors + self.n_raw

    @property
    def group_sizes(self) -> dict[str, int]:
        """The number of features in each group that is not empty, in order."""
        sizes = {
            "factors": self.n_factors,
            "shapes of factors": 2 * self.factor_frequencies * self.n_factors,
            "pairs of factors": self._n_pairs(self.n_factors),
            "raw features": self.n_raw_used,
            "shapes of raw features": 2 * self.raw_frequencies * self.n_raw_used,
            "pairs of raw features": self._n_pairs(self.n_raw_paired),
        }
        for name in ("maxima", "minima", "last values"):
            sizes[f"{name} of tracked inputs"] = self.n_tracked
            sizes[f"shapes of {name} of tracked inputs"] = 2 * self.history_frequencies * self.n_tracked
        return {name: size for name, size in sizes.items() if size}

    @property
    def n_raw_used(self) -> int:
        """The number of raw features that are used: all or none."""
        return self.n_raw if self.n_raw <= MAX_RAW_FEATURES else 0

    @property
    def n_raw_paired(self) -> int:
        """The number of raw features that are in pairs: all or none."""
        return self.n_raw if self.n_raw <= MAX_PAIRED_RAW_FEATURES else 0

    @property
    def factor_frequencies(self) -> int:
        """The number of frequencies of the shape of a factor."""
        return N_FREQUENCIES if self.extended else 0

    @property
    def raw_frequencies(self) -> int:
        """The number of frequencies of the shape of a raw feature."""
        n_free = max(0, MAX_FEATURES - self.n_factor_features - self.n_raw)
        return min(self.factor_frequencies, n_free // max(1, 2 * self.n_raw))

    @property
    def history_frequencies(self) -> int:
        """The number of frequencies of the shape of a largest, smallest or last value."""
        return min(N_FREQUENCIES, MAX_HISTORY_FEATURES // max(1, 6 * self.n_tracked))

    @property
    def n_factor_features(self) -> int:
        """The number of features that are functions of factors alone. They are the first ones."""
        return self.n_factors * (1 + 2 * self.factor_frequencies) + self._n_pairs(self.n_factors)

    def _n_pairs(self, n_inputs: int) -> int:
        return n_inputs * (n_inputs - 1) // 2 if self.extended else 0

    @property
    def n_features(self) -> int:
        return sum(self.group_sizes.values())

    @property
    def n_columns(self) -> int:
        """The number of weights of a fit: those of features, of the steps so far or of 1/T, and an intercept for each level."""
        return self.n_features + (self.prefixes or self.start_value) + self.n_levels

    @property
    def first_level_column(self) -> int:
        """The index of the first level's intercept among the weights."""
        return self.n_columns - self.n_levels

    @property
    def column_group_index(self) -> Int[np.ndarray, " columns"]:
        """The index of each weight's group."""
        return self._append_columns(self.group_index)

    @property
    def column_strength_index(self) -> Int[np.ndarray, " columns"]:
        """The index of each weight's strength."""
        return self._append_columns(self.strength_index)

    def _append_columns(self, index: Int[np.ndarray, " features"]) -> Int[np.ndarray, " columns"]:
        """Append the number of steps so far, or 1/T, as a group of its own, and the intercepts as the last group."""
        for n_new in (int(self.prefixes or self.start_value), self.n_levels):
            index = np.append(index, np.full(n_new, index.max(initial=-1) + 1))
        return index

    @property
    def group_index(self) -> Int[np.ndarray, " features"]:
        """The index of each feature's group."""
        return np.repeat(np.arange(len(self.group_sizes)), list(self.group_sizes.values()))

    @property
    def strength_index(self) -> Int[np.ndarray, " features"]:
        """The index of each feature's strength (`relevance.py`): each raw feature has one, and its shapes have one.

        All other features share the strength of their group.
        """
        index, n_strengths = [], 0
        for name, size in self.group_sizes.items():
            n_single = self.n_raw_used if name in ("raw features", "shapes of raw features") else 1
            index.append(n_strengths + np.arange(size) % n_single)
            n_strengths += n_single
        return np.concatenate([np.zeros(0, int), *index])

    @property
    def is_factor_feature(self) -> Bool[np.ndarray, " features"]:
        """Which features are functions of factors alone."""
        return np.arange(self.n_features) < self.n_factor_features

    def reads(self, inputs: Bool[Array, " standardised"]) -> Bool[Array, " features"]:
        """Return which features are functions of at least one of some inputs, or of its history."""
        factors, raw = inputs[: self.n_factors], inputs[self.n_factors : self.n_factors + self.n_raw_used]
        tracked = jnp.tile(inputs[: self.n_tracked], 1 + 2 * self.history_frequencies)
        return jnp.concatenate(
            [
                jnp.tile(factors, 1 + 2 * self.factor_frequencies),
                _reads_pairs(factors[: self.n_factors if self.extended else 0]),
                jnp.tile(raw, 1 + 2 * self.raw_frequencies),
                _reads_pairs(raw[: self.n_raw_paired if self.extended else 0]),
                *[tracked] * N_EXTREMES,
            ]
        )


def _reads_pairs(inputs: Bool[Array, " n"]) -> Bool[Array, " pairs"]:
    """Return which pairs have at least one of the inputs, in the order of `pair_products`."""
    i, j = np.triu_indices(len(inputs), 1)
    return inputs[i] | inputs[j]


def expand(basis: Basis, u: Float[Array, "*batch inputs"]) -> Float[Array, "*batch features"]:
    """Return the features of standardised inputs."""
    factors, raw = u[..., : basis.n_factors], u[..., basis.n_factors : basis.n_factors + basis.n_raw_used]
    if not basis.extended:
        return jnp.concatenate([factors, raw], axis=-1)
    return jnp.concatenate(
        [
            factors,
            fourier_terms(factors, basis.factor_frequencies),
            pair_products(factors),
            raw,
            fourier_terms(raw, basis.raw_frequencies),
            pair_products(raw[..., : basis.n_raw_paired]),
        ],
        axis=-1,
    )


def expand_history(
    basis: Basis, u: Float[Array, "*batch tracked"], history: Float[Array, "*batch 3 tracked"]
) -> Float[Array, "*batch features"]:
    """Return by how much a step changes the functions of largest, smallest and last values. Both arguments are standardised."""
    features = []
    for before, after in zip(
        jnp.unstack(history, axis=-2), jnp.unstack(next_history(history, u), axis=-2), strict=True
    ):
        is_first, before = jnp.isnan(before), jnp.nan_to_num(before)
        features.append(after - jnp.where(is_first, 0, before))
        shapes, shapes_before = (fourier_terms(values, basis.history_frequencies) for values in (after, before))
        features.append(shapes - jnp.where(jnp.tile(is_first, 2 * basis.history_frequencies), 0, shapes_before))
    return jnp.concatenate(features, axis=-1)


def pair_products(u: Float[Array, "*batch inputs"]) -> Float[Array, "*batch features"]:
    """Return u_i u_j for i < j, each clipped to four standard deviations."""
    i, j = np.triu_indices(u.shape[-1], 1)
    clipped = jnp.clip(u, -HALF_PERIOD, HALF_PERIOD)
    return clipped[..., i] * clipped[..., j]


def fourier_terms(u: Float[Array, "*batch inputs"], n_frequencies: int) -> Float[Array, "*batch features"]:
    """Return the terms of the Fourier series by frequency: first the cosines of all inputs, then their sines.

    Only the first frequency is computed directly: cos (k + 1) a = 2 cos a cos k a - cos (k - 1) a, and likewise for sines.
    """
    waves = _cos_sin(jnp.pi / HALF_PERIOD * jnp.clip(u, -HALF_PERIOD, HALF_PERIOD))
    previous, double_cos, terms = (jnp.ones_like(u), jnp.zeros_like(u)), 2 * waves[0], [u[..., :0]]
    for k in range(1, n_frequencies + 1):
        terms += [wave / k for wave in waves]
        previous, waves = waves, tuple(double_cos * wave - old for wave, old in zip(waves, previous, strict=True))
    return jnp.concatenate(terms, axis=-1)


def _cos_sin(angle: Float[Array, "*batch"]) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Return cosine and sine of angles between -pi and pi, to the precision of float32.

    XLA's own functions accept any angle but take fifteen times as long, which would be most of the time of a fit. Here the Taylor
    series is evaluated at half of each angle, and the angle is doubled.
    """
    half = angle / 2
    square, cosine, sine = half**2, 1.0, 1.0
    for n in range(11, 0, -2):
        cosine = 1 - square / (n * (n + 1)) * cosine
        sine = 1 - square / ((n + 1) * (n + 2)) * sine
    sine = half * sine
    return cosine**2 - sine**2, 2 * sine * cosine
