"""What an adapter asks of its assigner."""

import pytest

from helpers.shown import assigner
from lare_rl.errors import LareError
from lare_rl.integrations.space_checks import check_assigner


def test_what_is_no_assigner_is_refused():
    check_assigner(assigner())
    with pytest.raises(LareError, match=r"\Acredit must be a CreditAssigner, and is 'bayes'\Z"):
        check_assigner("bayes")
