"""Tasks as values."""

import pytest

from helpers.toy_envs import toy_spec
from lare_rl.errors import LareError
from lare_rl.tasks.spec import require_role, select_states


@pytest.mark.parametrize("key", ["name", "description", "observation", "action", "environment"])
def test_digest_depends_on_every_text(key):
    assert toy_spec().digest == toy_spec().digest
    assert toy_spec(**{key: "another"}).digest != toy_spec().digest


def test_select_states():
    assert [select_states(key, 0, 1) for key in ("before", "after", "both")] == [[0], [1], [0, 1]]


def test_require_role():
    assert require_role(toy_spec()) == toy_spec()
    teams = tuple(toy_spec(name=name, team=name) for name in ("cat", "mouse"))
    with pytest.raises(LareError, match="cat, mouse"):
        require_role(toy_spec(teams=teams))
