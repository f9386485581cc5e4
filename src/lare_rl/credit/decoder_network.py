"""The interface of decoders: networks from the inputs of a step to its proxy reward."""

import math
from typing import NamedTuple, Protocol, runtime_checkable

from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.credit.basis import Basis
from lare_rl.errors import LareError

__all__ = ["DecoderNetwork", "DecoderOutput", "DecoderShape"]


class DecoderOutput(NamedTuple):
    """A decoder's output for some steps."""

    r_hat: Float[Array, "rows *agents"]
    penalty: Float[Array, "rows *agents"]
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


class DecoderShape(NamedTuple):
    """The sizes that a decoder is made for."""

    basis: Basis
    """The inputs, and the features that a closed-form decoder computes from them."""
    max_steps: int
    """The number of steps of the longest episode."""
    n_agents: int
    inputs: tuple[tuple[str, int], ...] = ()
    """The name and the size of each input, in the order of the columns."""

    def sizes(self, *names: str) -> list[int]:
        """Return the sizes of the inputs. Raises `LareError` if their names, in order, are not `names`."""
        if tuple(name for name, _ in self.inputs) != names:
            raise LareError(
                f"this decoder reads the inputs {', '.join(names)}, and its method has {dict(self.inputs)}: register the method with "
                f"inputs=InputNames({names!r})"
            )
        return [size for _, size in self.inputs]

    @property
    def n_inputs(self) -> int:
        """The number of inputs of a step."""
        return self.basis.n_inputs

    @property
    def gain(self) -> float:
        """The factor of the output of decoders for several agents (see `decomposition.py`)."""
        return 1.0 if self.n_agents == 1 else math.sqrt(self.max_steps * self.n_agents)
