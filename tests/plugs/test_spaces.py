"""What an adapter asks of its assigner."""

import pytest

from lare.errors import LareError
from lare.plugs.spaces import check_assigner
from shown import assigner


def test_what_is_no_assigner_is_refused():
    check_assigner(assigner())
    with pytest.raises(LareError, match=r"\Acredit must be a CreditAssigner, and is 'bayes'\Z"):
        check_assigner("bayes")
