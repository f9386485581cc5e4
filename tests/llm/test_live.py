"""The live client against a misbehaving server on loopback."""

import gzip
import json
import threading
import time
from functools import partial

import pytest

from helpers.chat_servers import (
    Server,
    break_off,
    drip_headers,
    endless_body,
    hang_up,
    raw_answer,
    refuse,
    reply_with,
    reset_connection,
    send_bomb,
    text_completion,
    text_response,
)
from lare_rl.llm.budget import Budget, BudgetExceededError, max_request_tokens
from lare_rl.llm.live import LiveModel, ModelError
from lare_rl.llm.request_forms import FailedResponseError, RequestForms

KEY = "sk-secret-key-0123456789"
REQUEST = [{"role": "user", "content": "Write some."}]
ATTEMPTS, REPLY_TOKENS = 6, 16_384


@pytest.fixture
def serve(monkeypatch):
    """Start a server with its answers. Return it, a model that asks it, and the list of the model's pauses."""
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    monkeypatch.delenv("OPENAI_BASE_URL", raising=False)
    servers = []

    def serve(*answers, **settings):
        servers.append(Server(*answers))
        if "forms" not in settings:
            pytest.importorskip("openai.resources.responses")  # the client may be older
        pauses = []
        return servers[-1], LiveModel("m", servers[-1].url, sleep=pauses.append, **settings), pauses

    yield serve
    for server in servers:
        server.stop()


@pytest.fixture
def start(serve):
    """Start a server that is asked for chat completions."""
    return partial(serve, forms=RequestForms().without_responses())


@pytest.fixture(params=["responses", "chat"])
def start_either(request, serve):
    """Start a server of either API."""
    return serve if request.param == "responses" else partial(serve, forms=RequestForms().without_responses())


def test_request(start_either):
    server, model, pauses = start_either(reply_with("hello"), temperature=0.5)
    assert model.reply(REQUEST, 0) == "hello"
    (request,) = server.requests
    assert request["temperature"] == 0.5
    if server.apis == ["responses"]:
        schema = request["text"]["format"]["schema"]
        assert request["text"]["format"]["type"] == "json_schema"
        assert (request["input"], request["max_output_tokens"], request["store"]) == (REQUEST, REPLY_TOKENS, False)
    else:
        schema = request["response_format"]["json_schema"]["schema"]
        assert request["response_format"]["type"] == "json_schema"
        assert (request["messages"], request["max_completion_tokens"], "n" in request) == (REQUEST, REPLY_TOKENS, False)
    assert set(schema["properties"]) == set(schema["required"])
    assert server.headers[0]["Authorization"] == f"Bearer {KEY}"
    assert (model.budget.requests_used, model.budget.tokens_in, model.budget.tokens_out) == (1, 100, 10)
    assert pauses == []


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (reply_with(None), ""),
        (reply_with(None, refusal="I would rather not."), "I would rather not."),
        (reply_with("x" * 100_000), "x" * 100_000),
        (reply_with("a \ud800 b"), "a ? b"),  # a lone surrogate, which no file can store
        (reply_with(f"Your key is {KEY}."), "Your key is [key]."),
    ],
)
def test_reply_text(start_either, answer, text):
    server, model, _ = start_either(answer)
    assert model.reply(REQUEST, 0) == text
    assert "temperature" not in server.requests[0]


def test_truncated_reply_is_reported(start_either):
    def cut_off(handler):
        completion, response = text_completion("half of"), text_response("half of")
        completion["choices"][0]["finish_reason"] = "length"
        response |= {"status": "incomplete", "incomplete_details": {"reason": "max_output_tokens"}}
        handler.send(200, json.dumps(response if handler.api == "responses" else completion).encode())

    messages = []
    _, model, _ = start_either(cut_off, on_message=messages.append)
    assert model.reply(REQUEST, 0) == "half of"
    assert len(messages) == 2
    assert all(words in messages[1] for words in ("cut off", "16,384"))


REDIRECT = raw_answer(b"", 307, Location="/v2/chat")
COMPRESSED = gzip.compress(json.dumps(text_completion("hello")).encode())


@pytest.mark.parametrize(
    ("answers", "expected_pauses"),
    [
        ([raw_answer(COMPRESSED, Content_Encoding="gzip")], []),
        ([REDIRECT, reply_with("hello")], []),
        ([*map(refuse, (408, 409, 429)), reply_with("hello")], [0.5, 1.0, 2.0]),
        ([*map(refuse, (500, 503, 529)), reply_with("hello")], [0.5, 1.0, 2.0]),
        (
            [refuse(429, Retry_After=after) for after in ("3", "9999", "Wed, 21 Oct 2015 07:28:00 GMT")]
            + [reply_with("hello")],
            [3.0, 60.0, 2.0],
        ),
        *(([answer, reply_with("hello")], [0.5]) for answer in (hang_up, reset_connection, break_off)),
    ],
)
def test_reply_after_temporary_errors(start, answers, expected_pauses):
    server, model, pauses = start(*answers)
    assert model.reply(REQUEST, 0) == "hello"
    assert (len(server.requests), pauses) == (len(answers), expected_pauses)
    assert server.requests[0] == server.requests[-1]
    assert model.budget.requests_used == len(answers) - (answers[0] is REDIRECT)
    if answers[0] in (hang_up, reset_connection, break_off):
        assert model.budget.tokens_out == REPLY_TOKENS + 10


@pytest.mark.parametrize(
    ("answer", "n_requests", "words"),
    [
        (refuse(503), ATTEMPTS, ["HTTP 503"]),
        *(
            (raw_answer(body), ATTEMPTS, ["not a chat completion", reason])
            for body, reason in (
                (b'{"choices": [', "JSONDecodeError"),
                (b"<html>Bad gateway</html>", "'<html>Bad gateway</html>'"),
                (b"{}", "KeyError: 'choices'"),
                (b'{"choices": [{"message": null}]}', "AttributeError"),
                (b'{"choices": [{"message": {"content": ["x"]}}]}', "TypeError"),
                (b"[" * 5_000, "nested"),
            )
        ),
        (refuse(400, "you may not"), 4, ["HTTP 400", "you may not"]),  # the request changes three times
        (refuse(422, "you may not"), 4, ["HTTP 422", "you may not"]),
        (refuse(401, "you may not"), 1, ["HTTP 401", "you may not"]),
        (refuse(429, "insufficient_quota: pay first"), 1, ["HTTP 429", "pay first"]),
        (raw_answer(b"<html>\x1b[2J\xe2\x80\xae" + b"x" * 300, 403), 1, [f"'<html>?[2J?{'x' * 189}...'"]),
        (lambda handler: refuse(401, handler.headers["Authorization"])(handler), 1, ["Bearer [key]"]),
        (raw_answer(b"x" * 190 + KEY.encode(), 401), 1, [f"'{'x' * 190}[key]'"]),
        *(
            (raw_answer(b"", status, Location=location), 1, ["redirects to http"])
            for status, location in (
                (301, "https://elsewhere.example/v1"),
                (302, "http://127.0.0.1:1/v1/chat/completions"),
                (308, "//127.0.0.2/v1"),
            )
        ),
        (endless_body(200, b" " * (1 << 20)), 1, ["more than 8 MB"]),
        (send_bomb, ATTEMPTS, ["gzip, gzip"]),
    ],
)
def test_no_reply(start, answer, n_requests, words):
    """Only temporary errors are retried."""
    server, model, pauses = start(answer, budget=Budget(tokens=100_000_000))
    with pytest.raises(ModelError) as error:
        model.reply(REQUEST, 0)
    assert all(word in str(error.value) for word in words), str(error.value)
    assert "\n" not in str(error.value)
    assert KEY not in str(error.value)
    assert (len(server.requests), pauses) == (n_requests, [0.5, 1, 2, 4, 8] if n_requests == ATTEMPTS else [])
    assert server.headers[0]["Accept-Encoding"] == "identity"


def refuse_responses(answer, completion=None):
    """Answer requests of the Responses API in one way, and those for chat completions with a text or in another way."""
    return lambda handler: (answer if handler.api == "responses" else completion or reply_with("hello"))(handler)


@pytest.mark.parametrize(
    "answer",
    [
        *map(refuse, (403, 404, 405, 500, 501)),
        refuse(400, "text.format is not supported"),
        raw_answer(b'{"error": "Unexpected endpoint or method. (POST /v1/responses)"}'),
        raw_answer(b'{"output": [{"type": "message", "content": [{"text": 1}]}]}'),
    ],
)
def test_server_without_the_responses_api(serve, answer):
    server, model, pauses = serve(refuse_responses(answer))
    assert [model.reply(REQUEST, number) for number in range(2)] == ["hello"] * 2
    assert server.apis == ["responses", "completions", "completions"]
    assert server.requests[1]["response_format"]["type"] == "json_schema"
    assert (pauses, model.budget.requests_used) == ([], 3)
    assert model.reply(REQUEST, 0) == "hello"  # the model keeps what the server supports
    assert server.apis[3:] == ["completions"]


def test_refused_options_of_a_response(serve):
    refusals = [
        refuse(400, "Unsupported parameter: 'temperature' is not supported with this model."),
        refuse(400, "max_output_tokens is too large: at most 8192 tokens"),
    ]
    server, model, _ = serve(*refusals, reply_with("hello"), temperature=1.0)
    assert model.reply(REQUEST, 0) == "hello"
    assert server.apis == ["responses"] * 3
    assert ["temperature" in request for request in server.requests] == [True, False, False]
    limits = [request["max_output_tokens"] for request in server.requests]
    assert limits == [REPLY_TOKENS, REPLY_TOKENS, REPLY_TOKENS // 2]


def test_refusal_of_a_text_does_not_change_a_known_form(serve):
    server, model, _ = serve(reply_with("hello"), refuse(400, "against the rules"), reply_with("again"))
    assert model.reply(REQUEST, 0) == "hello"
    with pytest.raises(ModelError, match="against the rules"):
        model.reply(REQUEST, 1)
    assert model.reply(REQUEST, 2) == "again"
    assert server.apis == ["responses"] * 3


def test_error_of_a_known_responses_api_is_retried(serve):
    server, model, pauses = serve(reply_with("hello"), refuse(500), raw_answer(b"{}"), reply_with("again"))
    assert [model.reply(REQUEST, number) for number in range(2)] == ["hello", "again"]
    assert (server.apis, pauses) == (["responses"] * 4, [0.5, 1.0])
    failed = {"status": "failed", "error": {"code": "server_error", "message": "The model crashed."}, "output": []}
    _, model, pauses = serve(raw_answer(json.dumps(failed).encode()))
    with pytest.raises(ModelError, match="The model crashed"):
        model.reply(REQUEST, 0)
    assert len(pauses) == ATTEMPTS - 1
    with pytest.raises(FailedResponseError, match="The model crashed"):
        RequestForms().read_answer(b'{"status": "failed", "error": "The model crashed."}')


def hang(handler):
    threading.Event().wait(30)


@pytest.mark.parametrize("answer", [*(endless_body(status, b" ", 0.05) for status in (200, 500)), drip_headers, hang])
def test_slow_answer_ends_with_the_time_of_the_design(start, answer):
    messages = []
    server, model, _ = start(answer, budget=Budget(seconds=0.4), on_message=messages.append)
    began = time.monotonic()
    with pytest.raises(BudgetExceededError, match="Timeout"):
        model.reply(REQUEST, 0)
    assert "0 s at most" in messages[0]
    assert time.monotonic() - began < 5
    with pytest.raises(BudgetExceededError):
        model.reply(REQUEST, 1)
    assert len(server.requests) == 1


def test_unsupported_options_are_dropped_for_good(start):
    def answer(handler):
        request = handler.server.requests[-1]
        if "response_format" in request:
            return refuse(400, "response_format is not supported")(handler)
        if "max_completion_tokens" in request:
            return refuse(422, "unknown field max_completion_tokens")(handler)
        if request["max_tokens"] > 4096:
            return refuse(400, "max_tokens is too large: at most 4096 completion tokens")(handler)
        if "temperature" in request:
            return refuse(400, "temperature is not supported by this model")(handler)
        return reply_with("hello")(handler)

    server, model, pauses = start(answer, temperature=1.0)
    assert [model.reply(REQUEST, number) for number in range(2)] == ["hello"] * 2
    formats = [request.get("response_format", {}).get("type") for request in server.requests]
    assert formats[:3] == ["json_schema", "json_object", None]
    assert server.requests[-2:] == [{"model": "m", "messages": REQUEST, "max_tokens": 4096}] * 2
    assert pauses == []


@pytest.mark.parametrize(
    "usage",
    [
        {},
        {"prompt_tokens": "many", "completion_tokens": 1},
        {"prompt_tokens": float("inf"), "completion_tokens": 1},
        "many",
    ],
)
def test_bytes_are_counted_without_usage(start_either, usage):
    """All bytes of the answer count, because it may hold reasoning that the reply does not show."""
    _, model, _ = start_either(reply_with("grüße", usage=usage))
    model.reply(REQUEST, 0)
    assert model.budget.tokens_in == max_request_tokens(REQUEST)
    assert 50 < model.budget.tokens_out < 1000
    assert "upper bound" in model.budget.summary()


def test_token_budget(start):
    def use_all_tokens(handler):
        request = handler.server.requests[-1]
        usage = {
            "prompt_tokens": max_request_tokens(request["messages"]),
            "completion_tokens": request["max_completion_tokens"],
        }
        reply_with("x", usage=usage)(handler)

    server, model, _ = start(use_all_tokens, budget=Budget(tokens=max_request_tokens(REQUEST) + 1023))
    with pytest.raises(BudgetExceededError):  # no room for a reply
        model.reply(REQUEST, 0)
    assert server.requests == []
    server, model, _ = start(use_all_tokens, budget=Budget(tokens=40_000))
    assert [model.reply(REQUEST, number) for number in range(3)] == ["x"] * 3
    with pytest.raises(BudgetExceededError, match="40,000"):
        model.reply(REQUEST, 3)
    assert model.budget.tokens_in + model.budget.tokens_out == 40_000
    assert [request["max_completion_tokens"] for request in server.requests[:2]] == [REPLY_TOKENS] * 2


def test_pauses_count_as_waiting(start):
    messages = []
    _, model, pauses = start(
        refuse(429, Retry_After="999999999"), budget=Budget(seconds=150.0), on_message=messages.append
    )
    with pytest.raises(BudgetExceededError, match=r"no time is left.*of 150 s"):
        model.reply(REQUEST, 0)
    assert pauses == [60.0, 60.0]
    assert ("120 s at most" in messages[0], messages[1][-6:]) == (True, "60.0 s")


@pytest.mark.parametrize(("content", "temperature"), [("half of \ud800", None), ("x", float("nan"))])
def test_request_that_is_not_json(start, content, temperature):
    server, model, pauses = start(reply_with("hello"), temperature=temperature)
    with pytest.raises(ModelError, match="JSON"):
        model.reply([{"role": "user", "content": content}], 0)
    assert (server.requests, pauses, model.budget.tokens_out) == ([], [], 0)


def test_key_is_required_for_openai_only(start, monkeypatch):
    server, _, _ = start(reply_with("hello"))
    monkeypatch.delenv("OPENAI_API_KEY")
    with pytest.raises(ModelError, match="OPENAI_API_KEY"):
        LiveModel("m")
    monkeypatch.setenv("OPENAI_BASE_URL", server.url)
    assert LiveModel("m").reply(REQUEST, 0) == "hello"


URL = "http://127.0.0.1:1/v1"  # where nothing listens


@pytest.mark.parametrize(
    ("name", "key", "url", "n_pauses", "words"),
    [
        *((name, KEY, URL, 0, "not the name of a model") for name in ("", " ", "\udcff", "two\nlines")),
        *(("m", key, URL, 0, "OPENAI_API_KEY") for key in ("schlüssel", "two words", "line\nbreak")),
        *(
            ("m", KEY, url, n_pauses, words)
            for url, n_pauses, words in (
                ("nowhere", 0, "cannot be reached"),
                ("http://[", 5, ""),
                ("http://127.0.0.1:99999/v1", 5, ""),
                ("http://user:secret@127.0.0.1:notaport/v1", 0, "cannot be used"),
                ("user:secret@127.0.0.1/v1", 0, "cannot be reached"),
                ("http://user:secret@127.0.0.1:1/v1", 5, "http://127.0.0.1:1/v1/ cannot be reached"),
            )
        ),
    ],
)
def test_invalid_settings(monkeypatch, name, key, url, n_pauses, words):
    """The messages have no password."""
    monkeypatch.setenv("OPENAI_API_KEY", key)
    budget, pauses, messages = Budget(), [], []
    with pytest.raises(ModelError) as error:
        LiveModel(name, url, budget=budget, sleep=pauses.append, on_message=messages.append).reply(REQUEST, 0)
    assert words in str(error.value)
    assert "\n" not in str(error.value)
    assert "secret" not in " ".join([str(error.value), *messages])
    assert (len(pauses), budget.tokens_out) == (n_pauses, 0)
