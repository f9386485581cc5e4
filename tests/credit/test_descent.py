from dataclasses import replace

import pytest

from helpers.credit_specs import observation_spec
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.descent import BatchPlan, plan_batch
from lare_rl.credit.methods import METHODS, Fit


@pytest.mark.parametrize(
    ("fit", "longest", "fixed_length", "plan"),
    [
        (Fit.DECODER_LOSS, 50, False, BatchPlan("padded", 7, 50)),
        (Fit.SAMPLED_STEPS, 50, False, BatchPlan("sampled", 12, 8)),
        (Fit.SAMPLED_STEPS_UNBIASED, 50, True, BatchPlan("sampled", 2, 8)),
        (Fit.SAMPLED_STEPS, 5, False, BatchPlan("sampled", 12, 5)),
        (Fit.SAMPLED_STEPS, 500, True, BatchPlan("sampled", 1, 8)),
        (Fit.ALL_STEPS, 50, True, BatchPlan("padded", 2, 50)),
        (Fit.ALL_STEPS, 50, False, BatchPlan("packed", 50, 100)),
        (Fit.ALL_STEPS, 500, False, BatchPlan("packed", 50, 500)),
    ],
)
def test_plan_batch(fit, longest, fixed_length, plan):
    method, settings = (
        replace(METHODS["rd"], fit=fit),
        CreditSettings(batch_steps=100, sampled_steps=8, batch_episodes=7),
    )
    spec = observation_spec(1, method, settings, max_steps=1000, fixed_length=fixed_length)
    assert plan_batch(spec, longest) == plan
