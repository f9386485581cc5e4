"""Models of Pydantic AI as language models of a design."""

import asyncio
import json

import pytest

import lare_rl
from helpers.toy_envs import PHI, toy_spec
from lare_rl.errors import LareError

pydantic_ai = pytest.importorskip("pydantic_ai")

from pydantic_ai.messages import ModelMessagesTypeAdapter, ModelResponse, TextPart  # noqa: E402
from pydantic_ai.models.function import FunctionModel  # noqa: E402
from pydantic_ai.models.test import TestModel  # noqa: E402

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


def test_agent():
    agent = pydantic_ai.Agent(TestModel(custom_output_text=REPLY))
    assert lare_rl.design(toy_spec(), model=pydantic_ai_model(agent), candidates=2).source == PHI.strip("\n")


def test_model_in_a_running_loop():
    model, requests = record_requests("first", "second")
    adapted = pydantic_ai_model(model)

    async def ask():
        return [adapted.reply([{"role": "user", "content": "Write some."}], number) for number in range(2)]

    assert asyncio.run(ask()) == ["first", "second"]
    assert requests == [[("user-prompt", "Write some.")]] * 2


def test_errors():
    with pytest.raises(LareError, match="Pydantic AI cannot use 'nobody:m'"):
        pydantic_ai_model("nobody:m")

    def fail(messages, info):
        raise ConnectionError("no network")

    with pytest.raises(LareError, match="the model m failed: ConnectionError: no network"):
        lare_rl.design(toy_spec(), model=pydantic_ai_model(FunctionModel(fail, model_name="m")))
