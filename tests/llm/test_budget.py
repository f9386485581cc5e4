"""What a design may cost."""

import pytest

from lare_rl.llm.budget import Budget, BudgetSpent, most_tokens

ASKED = [{"role": "user", "content": "Grüße"}]


def test_no_request_has_more_tokens_than_bytes_and_a_few_for_each_message():
    assert most_tokens(ASKED) == 7 + 16
    assert most_tokens(ASKED * 2) == 2 * most_tokens(ASKED)


def test_what_is_left_is_what_a_reply_may_have():
    budget = Budget(tokens=100, tokens_in=30, tokens_out=20)
    assert budget.allow(ASKED) == 100 - 50 - 23
    with pytest.raises(BudgetSpent, match=r"might exceed the budget of 100 tokens \(50 are used\)"):
        budget.allow(ASKED * 3)


def test_no_request_is_allowed_beyond_the_last():
    with pytest.raises(BudgetSpent, match="the budget of 2 requests is spent"):
        Budget(requests=2, requests_made=2).allow(ASKED)


def test_costs_are_reckoned_by_given_prices():
    budget = Budget(requests_made=2, tokens_in=1_000_000, tokens_out=500_000)
    assert budget.summary() == "2 requests, 1,000,000 tokens in, 500,000 out"
    assert budget.summary((3.0, 15.0)) == "2 requests, 1,000,000 tokens in, 500,000 out, 10.5000 by the given prices"
