"""The settings of a decoder; which of them a method reads is a column of the table in `methods.py`."""

from typing import Annotated, Literal

from pydantic import Field

from lare.errors import Checked

RECENT = 5000
"""Steps over which proxy rewards are compared with the true ones: the newest, of every agent."""


class CreditSettings(Checked):
    """How the decoder is fitted."""

    hidden: tuple[Annotated[int, Field(ge=1)], ...] = (256, 256)
    """Widths of the decoder's hidden layers."""
    learning_rate: Annotated[float, Field(gt=0)] = 3e-4
    """Adam's step size."""
    weight_decay: Annotated[float, Field(ge=0)] = 0.0
    """Times the weights, added to their gradient."""
    normalise: bool = True
    """Normalise features and returns by running statistics. The published form does not."""
    sum_form: bool = False
    """Fit the return R of an episode (Eq. 6 of the paper), not its mean R/T (the published code)."""
    drawn_steps: Annotated[int, Field(ge=2)] = 64
    """K: steps drawn from an episode by RRD and its kin."""
    steps: Annotated[int, Field(ge=2)] = 256
    """Steps in one update of the decoder: K steps of so many episodes, or whole episodes that make up about as many. Where all
    episodes are equally long: of so many whole episodes, whatever is drawn from them."""
    episodes: Annotated[int, Field(ge=1)] = 8
    """diaster (single agents): whole episodes in one update of its decoder."""
    score: Literal["auto", "sum", "average"] = "auto"
    """Whether the score of an episode is a sum over its steps, or an average or a mark, which does not grow with them. `auto`: as
    the task says or, where it says nothing, the form that has predicted returns better so far."""
    optimism: Annotated[float, Field(ge=0)] = 0.0
    """lare-bayes and others in closed form: so many posterior deviations of a proxy reward are added to what the algorithm is paid.
    Steps that little is known of look better."""
    encoder: tuple[Annotated[int, Field(ge=1)], ...] = (256, 256)
    """Widths of the hidden layers of VIB's encoder."""
    bottleneck: Annotated[int, Field(ge=1)] = 8
    """Size of the code in the middle of VIB."""
    divergence: Annotated[float, Field(ge=0)] = 5e-3
    """Weight of the code's divergence beside the squared error of the mean (of the sum: T^2 times as much)."""
