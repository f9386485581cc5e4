"""Specs of small decoders."""

from dataclasses import replace

from lare_rl.credit.input_names import InputNames
from lare_rl.credit.spec import CreditSpec


def observation_spec(size, method, settings, max_steps, agents=1, fixed_length=True, **changes):
    """A spec of a method that reads the observation alone, which has this size."""
    return CreditSpec(
        method=replace(method, inputs=InputNames(("observation",))),
        settings=settings,
        observation_size=size,
        action_size=0,
        single_agent=agents == 1,
        agents=agents,
        max_steps=max_steps,
        fixed_length=fixed_length,
        **changes,
    )
