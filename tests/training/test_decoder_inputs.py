"""What the decoders of each method read of a step: for one agent, for many, and for whole teams."""

from functools import partial

import numpy as np
import pytest

from helpers.small_configs import ONE_TEAM, TOTAL, random_factors, random_steps, small_config, steps_as_stored
from lare_rl.training.decoder_inputs import decoder_inputs

MANY = partial(small_config, algorithm="ippo", env=ONE_TEAM)


def clip(action):
    return np.clip(action, -1, 1)


def flatten(action):
    return clip(action).reshape(TOTAL, 1, -1)


# Functions of observation, action, next observation and factors; of the state instead of the observation for a team.
SINGLE = [
    ("rrdu", "after", lambda o, a, n, z: [o, clip(a), o - n]),
    ("diaster", "after", lambda o, a, n, z: [o, clip(a)]),
    ("rudder", "after", lambda o, a, n, z: [o, clip(a), o - n]),
    ("bayes", "before", lambda o, a, n, z: [o, clip(a)]),
    ("bayes", "both", lambda o, a, n, z: [o, n, clip(a)]),
    ("rd-linear", "after", lambda o, a, n, z: [n, clip(a)]),
    ("lare-bayes", "both", lambda o, a, n, z: [z, o, n, clip(a)]),
    ("lare-linear", "both", lambda o, a, n, z: [z]),
    ("lare-rrdu", "before", lambda o, a, n, z: [z]),
]
AGENTS = [
    ("rd", "after", lambda o, a, n, z: [n]),
    ("stas", "after", lambda o, a, n, z: [o, a]),
    ("lare-rd", "after", lambda o, a, n, z: [z]),
]
TEAM = [
    ("rd", "after", lambda s, a, n, z: [n[:, None]]),
    ("rd-linear", "after", lambda s, a, n, z: [n[:, None], flatten(a)]),
    ("lare-linear", "after", lambda s, a, n, z: [z]),
]


@pytest.mark.parametrize(
    ("build", "observed", "method", "scored_observation", "expected"),
    [
        *((small_config, "observation", *row) for row in SINGLE),
        *((MANY, "observation", *row) for row in AGENTS),
        *((partial(MANY, credit_scope="state"), "state", *row) for row in TEAM),
    ],
)
def test_decoder_inputs(build, observed, method, scored_observation, expected):
    config = build(method, scored_observation=scored_observation)
    steps = random_steps(config.env)
    before, after = (getattr(timestep, observed)[:, 0] for timestep in (steps.timestep, steps.next_timestep))
    expected = np.concatenate(expected(before, steps.action[:, 0], after, random_factors(config, steps)[:, 0]), axis=-1)
    np.testing.assert_array_equal(decoder_inputs(steps_as_stored(config, steps), config, 0), expected)
    assert expected.shape[-1] == config.credit_specs[0].basis.n_inputs
    assert expected.shape[-2] == (config.n_proxy_rewards if observed == "state" else config.env.n_agents)
    assert config.credit_specs[0].basis.extended == (method in ("bayes", "lare-bayes"))
