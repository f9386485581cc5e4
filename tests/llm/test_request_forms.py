import json

import pytest

from lare_rl.llm.request_forms import RequestForms

ECHO = {
    "detail": [{"msg": "Field required", "input": {"content": "the maximum temperature", "max_output_tokens": 16384}}]
}


@pytest.mark.parametrize(
    ("body", "max_tokens", "reply_tokens"),
    [
        ("at most 2048 tokens", 16_384, 8192),
        ("at most 2048 tokens", 3000, 1500),  # the budget allowed no more than 3,000
        ("at most 2048 tokens", 1200, 1024),
        (json.dumps({"error": {"message": "too many tokens: the maximum is 2048"}}), 16_384, 8192),
        (json.dumps(ECHO), 16_384, 16_384),
    ],
)
def test_tokens_after_a_refusal(body, max_tokens, reply_tokens):
    forms = RequestForms().after_http_error(422, body, max_tokens, has_temperature=True)
    assert (forms.reply_tokens, forms.takes_temperature) == (reply_tokens, True)
    assert (forms.api == "chat") == (reply_tokens == 16_384)  # a refusal without a reason: the next form


def test_temperature_is_left_out_once():
    forms = RequestForms().after_http_error(400, "Unsupported parameter: temperature", 1024, has_temperature=True)
    assert (forms.takes_temperature, forms.api) == (False, "responses")
    assert "temperature" not in forms.request("m", [], 1024, 0.5)
    assert forms.after_http_error(400, "Unsupported parameter: temperature", 1024, has_temperature=True).api == "chat"
