"""What a run's files say of it."""

import json

import pytest

from helpers.toys import pick_spec, toy_spec
from lare_rl.config.resolve import decide
from lare_rl.config.settings import Settings
from lare_rl.runs.directory import Run, describe

QMIX = "the policy has not been updated in 90 steps: qmix needs 128 finished episodes for its first update (qmix.batch_size)"
RANDOM = "all 50 steps so far were random (td3.warmup is 60)"


@pytest.mark.parametrize(
    ("settings", "step", "loss", "said"),
    [
        ({"td3": {"warmup": 60}}, 50, {}, RANDOM),
        ({"td3": {"warmup": 60}}, 50, {"critic/loss": None}, RANDOM),
        ({"td3": {"warmup": 60}}, 90, {"critic/loss": 0.0}, None),
        ({"algorithm": "qmix", "method": "dense"}, 90, {}, QMIX),
        ({"algorithm": "qmix", "method": "dense"}, 90, {"critic/loss/prey": 2.0}, None),
    ],
)
def test_why_a_policy_has_not_been_updated(tmp_path, settings, step, loss, said):
    spec = pick_spec() if "algorithm" in settings else toy_spec()
    run = Run(tmp_path, describe(spec, decide(Settings(**{"method": "dense", "steps": 100} | settings), spec), ()), ())
    assert run.untrained is None  # nothing is known yet
    (tmp_path / "metrics.jsonl").write_text(
        json.dumps({"step": step, "seed": 0, "evaluation/return": 1.0, **loss}) + "\n"
    )
    assert run.untrained == said
