"""Models of Pydantic AI as language models of a design."""

import asyncio
import concurrent.futures
import json
import threading

import pytest

import lare_rl
from helpers.toy_envs import PHI, toy_spec
from lare_rl.errors import LareError

pydantic_ai = pytest.importorskip("pydantic_ai")

from pydantic_ai.messages import ModelMessagesTypeAdapter, ModelResponse, TextPart  # noqa: E402
from pydantic_ai.models.function import FunctionModel  # noqa: E402

from lare_rl.integrations.pydantic_ai import pydantic_ai_model  # noqa: E402

REPLY = json.dumps({"Understand": "", "Analyze": "", "Functions": PHI})


def record_requests(*replies):
    """Return a model of Pydantic AI with these replies, and the list of its requests: kinds of messages, and their texts."""
    replies, requests = list(replies), []

    def answer(messages, info):
        contents = [
            content for message in ModelMessagesTypeAdapter.dump_python(messages) for content in message["parts"]
        ]
        requests.append([(content["part_kind"], content["content"]) for content in contents])
        return ModelResponse([TextPart(replies.pop(0))])

    return FunctionModel(answer, model_name="m"), requests


def test_messages_are_converted():
    model, requests = record_requests("no function", REPLY)
    phi = lare_rl.design(toy_spec(), model=pydantic_ai_model(model), candidates=1)
    assert (phi.source, phi.model) == (PHI.strip("\n"), "m")
    system, user, reply, correction = requests[1]
    assert requests[0] == [system, user]
    assert [kind for kind, _ in requests[1]] == ["system-prompt", "user-prompt", "text", "user-prompt"]
    assert reply[1] == "no function"
    assert phi.exchanges[1]["messages"][-1]["content"] == correction[1]


def test_instructions_of_an_agent_are_sent():
    def answer(messages, info):
        assert info.instructions == "Be short."
        return recorder.function(messages, info)

    recorder, requests = record_requests("reply")
    agent = pydantic_ai.Agent(FunctionModel(answer, model_name="m"), instructions="Be short.", system_prompt="Be long.")
    messages = [{"role": "system", "content": "Design."}, {"role": "user", "content": "Write."}]
    assert pydantic_ai_model(agent).reply(messages, 0) == "reply"
    assert [text for _, text in requests[0]] == ["Design.", "Write."]


def test_interruption_cancels_the_request(monkeypatch):
    started, ended = threading.Event(), threading.Event()

    async def answer(messages, info):
        started.set()
        try:
            await asyncio.sleep(60)
        finally:
            ended.set()

    def interrupt(future):
        started.wait(30)
        raise KeyboardInterrupt

    model = pydantic_ai_model(FunctionModel(answer, model_name="m"))
    monkeypatch.setattr(concurrent.futures.Future, "result", interrupt)
    with pytest.raises(KeyboardInterrupt):
        model.reply([{"role": "user", "content": "Write."}], 0)
    assert ended.wait(30)


def test_model_in_a_running_loop():
    model, requests = record_requests("first", "second")
    adapted = pydantic_ai_model(model)

    async def ask():
        return [adapted.reply([{"role": "user", "content": "Write some."}], number) for number in range(2)]

    assert asyncio.run(ask()) == ["first", "second"]
    assert requests == [[("user-prompt", "Write some.")]] * 2


def test_errors(monkeypatch):
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    for model in ("nobody:m", "openai:gpt-5"):
        with pytest.raises(LareError, match=f"Pydantic AI cannot use '{model}'"):
            pydantic_ai_model(model)
    for model in (None, pydantic_ai.Agent()):
        with pytest.raises(LareError, match="has no model"):
            pydantic_ai_model(model)

    def fail(messages, info):
        raise ConnectionError("no network")

    with pytest.raises(LareError, match="the model m failed: ConnectionError: no network"):
        lare_rl.design(toy_spec(), model=pydantic_ai_model(FunctionModel(fail, model_name="m")))
