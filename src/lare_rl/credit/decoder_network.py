"""The interface of decoders: networks from the inputs of a step to its proxy reward."""

from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
from jaxtyping import Array, Float, PRNGKeyArray

__all__ = ["DecoderNetwork", "DecoderOutput", "FirstInput", "split_key"]


class DecoderOutput(NamedTuple):
    """A decoder's output for some steps."""

    r_hat: Float[Array, "rows *agents"]
    penalty: Float[Array, "rows *agents"] | None = None
    """The mean of the penalty over the agents that are alive is added to the loss."""
    log_std: Float[Array, "rows *agents"] | None = None
    """The log standard deviation of the rewards, for `Fit.LIKELIHOOD`."""


@runtime_checkable
class DecoderNetwork(Protocol):
    """A decoder, which is an `equinox.Module`.

    A decoder for `Fit.DECODER_LOSS` has another method, `loss`, as in `diaster.py`.
    """

    def __call__(self, inputs: Float[Array, "rows *agents inputs"], key: PRNGKeyArray | None) -> DecoderOutput:
        """Return the proxy rewards of some steps.

        Args:
            key: the random key of an update of the decoder. Rewards for the algorithm are computed without a key.
        """
        ...


def split_key(key: PRNGKeyArray | None, count: int) -> list[PRNGKeyArray | None]:
    """Return random keys for the layers of a decoder, or as many None if it has no key."""
    return [None] * count if key is None else list(jax.random.split(key, count))


class FirstInput(eqx.Module):
    """The network of a method that fits nothing: r_hat is the first input, as a designed reward is."""

    def __call__(self, inputs: Float[Array, "rows *agents inputs"], key: PRNGKeyArray | None) -> DecoderOutput:
        return DecoderOutput(inputs[..., 0])
