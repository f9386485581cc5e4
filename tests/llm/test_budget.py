"""The budget of a design."""

import pytest

from lare_rl.llm.budget import Budget, BudgetExceededError

REQUEST = [{"role": "user", "content": "Grüße"}]


def test_max_reply_tokens():
    budget = Budget(tokens=100, tokens_in=30, tokens_out=20)
    assert budget.max_reply_tokens(REQUEST, 27) == 100 - 50 - (7 + 16)  # 7 bytes in UTF-8
    with pytest.raises(BudgetExceededError, match=r"100 tokens \(50 are used\)"):
        budget.max_reply_tokens(REQUEST, 28)


def test_summary_with_prices():
    budget = Budget(requests_used=2, tokens_in=1_000_000, tokens_out=500_000)
    assert budget.summary().startswith("2 requests, 1,000,000 tokens in, 500,000 out")
    assert "10.5000" in budget.summary((3.0, 15.0))
