"""The table of algorithms, and what is made of it elsewhere."""

from typing import get_args

import pytest

from lare_rl.algorithms.table import ALGORITHMS, TABLE, Name
from lare_rl.config.settings import Settings


def test_names_are_those_of_the_types():
    assert tuple(ALGORITHMS) == get_args(Name)
    assert len(ALGORITHMS) == len(TABLE)


@pytest.mark.parametrize("discrete", [False, True])
def test_choices_of_a_distribution_are_sampled(discrete):
    sampled = {row.name for row in TABLE if not row.greedy(discrete)}
    assert sampled == ({"ppo", "ippo"} if discrete else {"ippo"})


def test_every_algorithm_has_settings_of_its_own_that_start_as_published():
    assert all(getattr(Settings(), row.name) == row.settings for row in TABLE)
