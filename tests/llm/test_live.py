"""The live client against a real server on loopback that misbehaves."""

import gzip
import json
import threading
import time

import pytest

from helpers.servers import (
    Server,
    completion,
    dribbles,
    floods,
    half,
    hangs_up,
    packed,
    raw,
    refuses,
    refuses_slowly,
    refuses_without_end,
    resets,
    says,
    spells_headers,
)
from lare_rl.llm import budget, live
from lare_rl.llm.budget import Budget, BudgetSpent, most_tokens
from lare_rl.llm.live import LADDER, LiveModel, ModelFailed

KEY = "sk-secret-key-0123456789"
ASKED = [{"role": "user", "content": "Write some."}]


@pytest.fixture
def served(monkeypatch):
    """Starts a server with its answers; gives it, a model that asks it, and the seconds that the model waited."""
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    monkeypatch.delenv("OPENAI_BASE_URL", raising=False)
    servers = []

    def start(*answers, **changes):
        servers.append(Server(*answers))
        waited = []
        model = LiveModel("m", servers[-1].url, sleep=waited.append, **changes)
        return servers[-1], model, waited

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


def test_a_reply_and_what_was_asked(served):
    server, model, waited = served(says("hello"), temperature=0.5)
    assert model.reply(ASKED, 0) == "hello"
    (request,) = server.requests
    assert request["messages"] == ASKED
    assert request["response_format"] == LADDER[0]
    assert request["max_completion_tokens"] == live.REPLY_TOKENS
    assert request["temperature"] == 0.5
    assert "n" not in request
    assert server.headers[0]["Authorization"] == f"Bearer {KEY}"
    assert (model.budget.requests_made, model.budget.tokens_in, model.budget.tokens_out) == (1, 100, 10)
    assert waited == []


def test_a_reply_that_was_cut_off_is_said_to_be(served):
    answer = completion("half of")
    answer["choices"][0]["finish_reason"] = "length"
    said = []
    _, model, _ = served(lambda handler: handler.send(200, json.dumps(answer).encode()), said=said.append)
    assert model.reply(ASKED, 0) == "half of"
    assert said[1:] == ["m: a reply was cut off at the 16,384 tokens that it was allowed"]


def test_no_request_is_made_that_leaves_no_room_for_a_reply(served):
    server, model, _ = served(says("hello"), budget=Budget(tokens=most_tokens(ASKED) + live.SHORTEST_REPLY - 1))
    with pytest.raises(BudgetSpent, match="might exceed the budget"):
        model.reply(ASKED, 0)
    assert server.requests == []


@pytest.mark.parametrize("status", [408, 409, 429, 500, 502, 503, 529])
def test_what_may_pass_is_tried_again(served, status):
    server, model, waited = served(refuses(status), refuses(status), says("hello"))
    assert model.reply(ASKED, 0) == "hello"
    assert len(server.requests) == model.budget.requests_made == 3
    assert waited == [0.5, 1.0]


def test_the_server_says_how_long_to_wait(served):
    _, model, waited = served(
        refuses(429, Retry_After="3"),
        refuses(429, Retry_After="9999"),
        refuses(429, Retry_After="Wed, 21 Oct 2015 07:28:00 GMT"),
        says("hello"),
    )
    assert model.reply(ASKED, 0) == "hello"
    assert waited == [3.0, live.LONGEST_WAIT, 2.0]


@pytest.mark.parametrize("answer", [hangs_up, resets, half])
def test_a_connection_that_breaks_is_tried_again(served, answer):
    server, model, waited = served(answer, says("hello"))
    assert model.reply(ASKED, 0) == "hello"
    assert (len(server.requests), waited) == (2, [0.5])


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (b"", "JSONDecodeError"),
        (b'{"choices": [', "JSONDecodeError"),
        (b"<html>Bad gateway</html>", "JSONDecodeError"),
        (b"null", "TypeError"),
        (b"[]", "TypeError"),
        (b"{}", "KeyError: 'choices'"),
        (b'{"choices": []}', "IndexError"),
        (b'{"choices": [{}]}', "KeyError: 'message'"),
        (b'{"choices": [{"message": null}]}', "AttributeError"),
        (b'{"choices": [{"message": {"content": ["x"]}}]}', "TypeError: the content is not a text"),
        (b"[" * 5_000, "ValueError: it is nested more than 64 deep"),
    ],
)
def test_an_answer_that_is_none_is_tried_again_and_then_named(served, body, said):
    server, model, _ = served(raw(body))
    with pytest.raises(ModelFailed, match=r"\Am did not answer: the answer is not a chat completion \(") as error:
        model.reply(ASKED, 0)
    assert said in str(error.value)
    assert len(server.requests) == live.TRIES
    assert model.budget.estimated


@pytest.mark.parametrize("status", [400, 401, 403, 404, 422])
def test_what_will_not_pass_is_not_tried_for_ever(served, status):
    server, model, waited = served(refuses(status, "you may not"))
    with pytest.raises(ModelFailed, match=f"m did not answer: HTTP {status}: .*you may not"):
        model.reply(ASKED, 0)
    assert len(server.requests) == (4 if status in (400, 422) else 1)
    assert waited == []


def test_an_empty_purse_is_not_tried_again(served):
    server, model, _ = served(refuses(429, "insufficient_quota: pay first"))
    with pytest.raises(ModelFailed, match="pay first"):
        model.reply(ASKED, 0)
    assert len(server.requests) == 1


def test_a_server_that_never_comes_back(served):
    server, model, waited = served(refuses(503))
    with pytest.raises(ModelFailed, match="m did not answer: HTTP 503"):
        model.reply(ASKED, 0)
    assert len(server.requests) == live.TRIES
    assert waited == [0.5, 1, 2, 4, 8]


def test_nobody_there(served):
    server, model, waited = served(says("hello"))
    server.shutdown()
    server.server_close()
    with pytest.raises(
        ModelFailed, match=r"m did not answer: http://127\.0\.0\.1:\d+/v1/ cannot be reached: .*refused"
    ):
        model.reply(ASKED, 0)
    assert len(waited) == live.TRIES - 1


@pytest.mark.parametrize("answer", [dribbles, floods, refuses_slowly, refuses_without_end, spells_headers])
def test_an_answer_without_end_is_cut_off(served, monkeypatch, answer):
    monkeypatch.setattr(budget, "TIMEOUT", 0.3)
    monkeypatch.setattr(budget, "SHARE", 0)
    monkeypatch.setattr(live, "TRIES", 1)
    _, model, _ = served(answer)
    with pytest.raises(ModelFailed, match=r"was not complete after|has more than 8 MB"):
        model.reply(ASKED, 0)


@pytest.mark.parametrize(("seconds", "longest"), [(60.0, 120.0), (900.0, 120.0), (3600.0, 450.0)])
def test_one_reply_may_take_an_eighth_of_the_time(seconds, longest):
    assert Budget(seconds=seconds).timeout == longest


def test_the_ladder_goes_down_and_stays_down(served):
    def picky(handler):
        request = handler.server.requests[-1]
        if "response_format" in request:
            return refuses(400, "response_format is not supported")(handler)
        if "max_completion_tokens" in request:
            return refuses(422, "unknown field max_completion_tokens")(handler)
        if request["max_tokens"] > 4096:
            return refuses(400, "max_tokens is too large: at most 4096 completion tokens")(handler)
        if "temperature" in request:
            return refuses(400, "temperature is not supported by this model")(handler)
        return says("hello")(handler)

    server, model, waited = served(picky, temperature=1.0)
    assert model.reply(ASKED, 0) == "hello"
    assert model.reply(ASKED, 1) == "hello"
    last = server.requests[-1]
    assert last == {"model": "m", "messages": ASKED, "max_tokens": 4096}
    assert server.requests[-2] == last
    assert waited == []


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (says(""), ""),
        (says(None), ""),
        (says(None, refusal="I would rather not."), "I would rather not."),
        (says("x" * 100_000), "x" * 100_000),
    ],
)
def test_the_text_is_given_on_as_it_came(served, answer, text):
    _, model, _ = served(answer)
    assert model.reply(ASKED, 0) == text


@pytest.mark.parametrize(
    "usage",
    [
        {},
        {"prompt_tokens": None},
        {"prompt_tokens": "many", "completion_tokens": 1},
        {"prompt_tokens": float("inf"), "completion_tokens": 1},
        {"prompt_tokens": 10**400, "completion_tokens": 1},
        {"prompt_tokens": 1, "completion_tokens": -1},
    ],
)
def test_a_server_that_counts_nothing_is_counted_by_bytes(served, usage):
    _, model, _ = served(says("grüße", usage=usage))
    model.reply(ASKED, 0)
    assert (model.budget.tokens_in, model.budget.tokens_out) == (most_tokens(ASKED), 7)
    assert "counted as bytes" in model.budget.summary()


@pytest.mark.parametrize(
    ("encoding", "times", "said"),
    [
        ("gzip", 1, "the answer has more than 8 MB"),
        ("gzip, gzip", 2, "is packed as gzip, gzip, which was not asked for"),
    ],
)
def test_a_little_that_unpacks_to_a_lot(served, monkeypatch, encoding, times, said):
    monkeypatch.setattr(live, "TRIES", 1)
    server, model, _ = served(packed(encoding, times))
    with pytest.raises(ModelFailed, match=said):
        model.reply(ASKED, 0)
    assert server.headers[0]["Accept-Encoding"] == "identity"


def test_a_server_that_packs_all_the_same(served):
    body = gzip.compress(json.dumps(completion("hello")).encode())
    _, model, _ = served(raw(body, Content_Encoding="gzip"))
    assert model.reply(ASKED, 0) == "hello"


def test_what_may_have_been_answered_is_counted(served):
    _, model, _ = served(half, says("hello"))
    model.reply(ASKED, 0)
    assert model.budget.tokens_out == live.REPLY_TOKENS + 10


@pytest.mark.parametrize("url", ["nowhere", "ftp://127.0.0.1:1/v1"])
def test_what_is_hopeless_is_tried_once(url):
    waited = []
    model = LiveModel("m", url, sleep=waited.append)
    with pytest.raises(ModelFailed, match="cannot be reached"):
        model.reply(ASKED, 0)
    assert (waited, model.budget.requests_made, model.budget.tokens_out) == ([], 1, 0)


def test_half_a_character_is_none(served):
    """JSON can say it, and no file could keep it."""
    body = json.dumps(completion("a \ud800 b")).encode()
    _, model, _ = served(raw(body))
    assert model.reply(ASKED, 0) == "a ? b"


@pytest.mark.parametrize("key", ["schlüssel", "two words", "line\nbreak"])
def test_a_key_that_is_none(monkeypatch, key):
    monkeypatch.setenv("OPENAI_API_KEY", key)
    with pytest.raises(
        ModelFailed, match="the environment variable OPENAI_API_KEY holds characters that no key can have"
    ):
        LiveModel("m", "http://127.0.0.1:1/v1")


@pytest.mark.parametrize("name", ["", " ", "\udcff", "two\nlines"])
def test_a_model_without_a_name(name):
    with pytest.raises(ModelFailed, match="is not the name of a model"):
        LiveModel(name, "http://127.0.0.1:1/v1")


def test_the_budget_of_requests_is_never_passed(served):
    server, model, _ = served(refuses(500), budget=Budget(requests=3))
    with pytest.raises(BudgetSpent, match="the budget of 3 requests is spent; the last try failed: HTTP 500: "):
        model.reply(ASKED, 0)
    assert len(server.requests) == 3


def test_the_budget_of_tokens_is_never_passed(served):
    # The server takes everything that it is allowed.
    def greedy(handler):
        request = handler.server.requests[-1]
        usage = {
            "prompt_tokens": most_tokens(request["messages"]),
            "completion_tokens": request["max_completion_tokens"],
        }
        handler.send(200, json.dumps(completion("x", usage)).encode())

    server, model, _ = served(greedy, budget=Budget(tokens=40_000))
    assert [model.reply(ASKED, number) for number in range(3)] == ["x"] * 3
    with pytest.raises(BudgetSpent, match=r"might exceed the budget of 40,000 tokens \(40,000 are used\)"):
        model.reply(ASKED, 3)
    assert model.budget.tokens_in + model.budget.tokens_out == 40_000
    assert [request["max_completion_tokens"] for request in server.requests[:2]] == [live.REPLY_TOKENS] * 2


def test_a_server_that_tells_the_key_is_not_quoted(served):
    def tells(handler):
        refuses(401, f"Incorrect key provided: {handler.headers['Authorization']}")(handler)

    _, model, _ = served(tells)
    with pytest.raises(ModelFailed, match=r"Bearer \[key\]") as error:
        model.reply(ASKED, 0)
    assert KEY not in str(error.value)
    assert error.value.__cause__ is None
    assert error.value.__suppress_context__ or error.value.__context__ is None
    _, model, _ = served(says(f"Your key is {KEY}."))
    assert model.reply(ASKED, 0) == "Your key is [key]."
    assert KEY not in repr(model)


@pytest.mark.parametrize(
    ("location", "said"),
    [
        ("https://elsewhere.example/v1", "it redirects to https://elsewhere.example, another server"),
        ("http://127.0.0.1:1/v1/chat/completions", "it redirects to http://127.0.0.1:1, another server"),
        ("//127.0.0.2/v1", "it redirects to http://127.0.0.2, another server"),
    ],
)
@pytest.mark.parametrize("status", [301, 302, 307, 308])
def test_nobody_is_sent_to_another_server(served, status, location, said):
    server, model, waited = served(raw(b"", status, Location=location))
    with pytest.raises(ModelFailed) as error:
        model.reply(ASKED, 0)
    assert str(error.value).endswith(f"{said}: name that one to use it")
    assert (len(server.requests), waited) == (1, [])


def test_a_redirect_within_a_server_is_followed(served):
    server, model, _ = served(raw(b"", 307, Location="/v2/chat"), says("hello"))
    assert model.reply(ASKED, 0) == "hello"
    assert server.requests[0] == server.requests[1]


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (raw(b"Your plan has ended.", 401), "HTTP 401: Error code: 401: 'Your plan has ended.'"),
        (
            raw(b"<html>\x1b[2J\xe2\x80\xae" + b"x" * 300, 403),
            f"HTTP 403: Error code: 403: '<html>?[2J?{'x' * 189}...'",
        ),
        (raw(b"", 401), "HTTP 401: Error code: 401"),
        (
            raw(b"Good evening"),
            "the answer is not a chat completion (JSONDecodeError: Expecting value: line 1 column 1 (char 0)): 'Good evening'",
        ),
    ],
)
def test_what_is_no_json_is_shown(served, monkeypatch, answer, said):
    monkeypatch.setattr(live, "TRIES", 1)
    _, model, _ = served(answer)
    with pytest.raises(ModelFailed) as error:
        model.reply(ASKED, 0)
    assert str(error.value) == f"m did not answer: {said}"


def hangs(handler):
    threading.Event().wait(30)


def test_a_connection_that_hangs_ends_with_the_time_of_the_design(served):
    said = []
    server, model, _ = served(hangs, budget=Budget(seconds=1.0), said=said.append)
    start = time.monotonic()
    with pytest.raises(BudgetSpent) as error:
        model.reply(ASKED, 0)
    assert time.monotonic() - start < 5
    assert str(error.value) == (
        "the 1 s of waiting for the model are over (1 s are used, and 0 s are to be waited); the last try failed: "
        "TimeoutError: the answer was not complete after 1 s"
    )
    assert said[0] == "m: waiting for a reply, 1 s at most (1 s are left for all)"
    with pytest.raises(BudgetSpent):
        model.reply(ASKED, 1)
    assert len(server.requests) == 1


def test_nobody_waits_longer_than_a_design_may_take(served):
    said = []
    _, model, waited = served(refuses(429, Retry_After="999999999"), budget=Budget(seconds=150.0), said=said.append)
    with pytest.raises(
        BudgetSpent, match=r"the 2 minutes of waiting for the model are over \(12\d s are used, and 60 s are to"
    ):
        model.reply(ASKED, 0)
    assert waited == [60.0, 60.0]
    assert said[0] == "m: waiting for a reply, 120 s at most (2 minutes are left for all)"
    assert said[1].endswith("trying again in 60.0 s")


def test_without_key_and_server_it_says_what_to_do(monkeypatch):
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    monkeypatch.delenv("OPENAI_BASE_URL", raising=False)
    with pytest.raises(ModelFailed, match="put a key into the environment variable OPENAI_API_KEY, or name a server"):
        LiveModel("m")


def test_a_server_of_ones_own_needs_no_key(monkeypatch):
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    server = Server(says("hello"))
    monkeypatch.setenv("OPENAI_BASE_URL", server.url)
    try:
        assert LiveModel("m").reply(ASKED, 0) == "hello"
    finally:
        server.shutdown()
        server.server_close()


@pytest.mark.parametrize("url", ["", "nowhere", "ftp://x/", "http://[", "http://127.0.0.1:99999/v1"])
def test_an_endpoint_that_is_none(monkeypatch, url):
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    monkeypatch.setattr(live, "TRIES", 1)
    with pytest.raises(ModelFailed) as error:
        LiveModel("m", url or " ").reply(ASKED, 0)
    assert "\n" not in str(error.value)
