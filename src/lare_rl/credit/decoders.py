"""The registry of decoders: networks from the inputs of a step to its proxy reward.

A method names its decoder. `register_decoder` adds another one, for this package and for plugins alike:

    register_decoder(Decoder("squares", init_squares, frozenset({"hidden"})))
"""

from collections.abc import Callable
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import TYPE_CHECKING

from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.errors import LareError, short_repr
from lare_rl.util.plugins import Registry

if TYPE_CHECKING:  # importing JAX takes longer than all else that the command line does before it shows a message
    from lare_rl.credit.decoder_network import DecoderNetwork

__all__ = ["DECODERS", "RBT_STEPS", "Decoder", "register_decoder"]


@dataclass(frozen=True)
class Decoder:
    """A kind of decoder."""

    name: str
    init: "Callable[..., DecoderNetwork] | str"
    """A class or function that returns an untrained decoder from a random key and a `CreditSpec`. `module:name` is imported when it
    is needed."""
    settings: frozenset[str] = frozenset()
    """The names of the `CreditSettings` that `init` reads."""
    whole_episodes: bool = False
    """Whether its rows must be whole episodes of the same length, one after another. Such a decoder is for several agents."""
    single_agent_only: bool = False
    closed_form: bool = False
    """Whether it is linear in features, and its weights are solved for, not trained."""
    extended_basis: bool = False
    """Whether a closed-form decoder has shapes and pairs of its inputs as features (`basis.py`)."""
    pays_shares: bool = False
    """Whether its outputs are shares of the return, over steps and agents (`tar2.py`). It needs `whole_episodes`."""
    predicts_actions: bool = False
    """Whether it learns to predict which action an agent took, which must then be discrete."""
    longest_segment: int | None = None
    """The largest number of steps of a payment that it reads. None means any number."""

    def __post_init__(self) -> None:
        if not isinstance(self.settings, set | frozenset) or not self.settings <= CreditSettings.model_fields.keys():
            names = ", ".join(CreditSettings.model_fields)
            raise LareError(
                f"decoder {self.name}: settings = {short_repr(self.settings)}: give a set of names of {names}"
            )
        if self.pays_shares and not self.whole_episodes:
            raise LareError(
                f"decoder {self.name}: a decoder that pays shares of an episode's return needs whole_episodes"
            )

    def load_init(self) -> "Callable[..., DecoderNetwork]":
        """Return `init`, imported."""
        return resolve_name(self.init) if isinstance(self.init, str) else self.init


RBT_STEPS = 512
"""The largest number of steps of a payment for RBT: half of the 1,024 tokens that the authors' transformer reads."""

DECODERS = Registry[Decoder]("decoder")


def register_decoder(decoder: Decoder) -> None:
    """Add a decoder, which methods can then name. Raises `LareError` if another decoder has this name."""
    DECODERS.register(decoder.name, decoder)


for _decoder in (
    Decoder("step", "lare_rl.credit.step_decoders:StepDecoder", frozenset({"hidden"})),
    Decoder(
        "bottleneck",
        "lare_rl.credit.step_decoders:Bottleneck",
        frozenset({"hidden", "encoder", "bottleneck", "divergence"}),
    ),
    Decoder("lrr", "lare_rl.credit.lrr:LRR", frozenset({"hidden"})),
    Decoder("arel", "lare_rl.credit.arel:AREL", whole_episodes=True),
    Decoder("stas", "lare_rl.credit.stas:STAS", whole_episodes=True),
    Decoder("tar2", "lare_rl.credit.tar2:TAR2", whole_episodes=True, pays_shares=True, predicts_actions=True),
    Decoder("diaster", "lare_rl.credit.diaster:Diaster", frozenset({"hidden"}), single_agent_only=True),
    Decoder("rudder", "lare_rl.credit.rudder:RUDDER", frozenset({"hidden"}), single_agent_only=True),
    Decoder("grd", "lare_rl.credit.grd:GRD", frozenset({"hidden", "sparsity"}), single_agent_only=True),
    Decoder("rbt", "lare_rl.credit.rbt:RBT", frozenset({"hidden"}), single_agent_only=True, longest_segment=RBT_STEPS),
    Decoder("linear", "lare_rl.credit.linear_decoder:init_from_spec", closed_form=True),
    Decoder("additive", "lare_rl.credit.linear_decoder:init_from_spec", closed_form=True, extended_basis=True),
):
    register_decoder(_decoder)
