"""Language models of Pydantic AI: Anthropic, Google, Bedrock, Mistral and others.

model = pydantic_ai_model("anthropic:claude-sonnet-4-5")
phi = lare_rl.design(task, model=model)
"""

import asyncio
import threading
from functools import cache
from typing import Any

from lare_rl.errors import LareError, missing_extra_error, short_repr
from lare_rl.llm.model import FunctionModel
from lare_rl.llm.prompts import Message

try:
    from pydantic_ai import Agent
    from pydantic_ai.messages import ModelRequest, ModelResponse, SystemPromptPart, TextPart, UserPromptPart
except ImportError as missing:
    raise missing_extra_error("lare_rl.integrations.pydantic_ai", "pydantic-ai") from missing

__all__ = ["pydantic_ai_model"]

_LOCK = threading.Lock()
"""Held while the loop is started: without it, `cache` may call `_event_loop` several times at once."""


def pydantic_ai_model(model: Any) -> FunctionModel:
    """Return a model that asks Pydantic AI, for `lare_rl.design(task, model=...)`.

    `model` is the name of a model (`anthropic:claude-sonnet-4-5`), a model of Pydantic AI, or an `Agent` that returns texts. The
    `instructions` of an agent are sent; its `system_prompt` is not, because each request has one.

    Raises:
        LareError: there is no such model, or its key is missing.
    """
    try:
        agent = model if isinstance(model, Agent) else Agent(model)
    except Exception as error:  # Pydantic AI, and the client of each provider, raise their own
        raise LareError(f"Pydantic AI cannot use {short_repr(model)}: {error}") from error
    if agent.model is None:
        raise LareError("the agent has no model: give one, such as Agent('anthropic:claude-sonnet-4-5')")

    def ask(messages: list[Message]) -> str:
        history = [_convert(message) for message in messages[:-1]]
        run = agent.run(messages[-1]["content"], message_history=history)
        with _LOCK:
            future = asyncio.run_coroutine_threadsafe(run, _event_loop())
        try:
            return future.result().output
        finally:
            future.cancel()  # after an interruption; it does nothing to a request that has ended

    return FunctionModel(ask, str(getattr(agent.model, "model_name", agent.model)))


@cache
def _event_loop() -> asyncio.AbstractEventLoop:
    """Return the one loop of all requests: a connection works only in the loop that opened it.

    It has its own thread, because in a notebook the main thread already runs a loop.
    """
    loop = asyncio.new_event_loop()
    threading.Thread(target=loop.run_forever, daemon=True).start()
    return loop


def _convert(message: Message) -> ModelRequest | ModelResponse:
    if message["role"] == "assistant":
        return ModelResponse([TextPart(content=message["content"])])
    kind = SystemPromptPart if message["role"] == "system" else UserPromptPart
    return ModelRequest([kind(content=message["content"])])
