"""The interface of a language model: a name, and replies. The design loop uses nothing else of a model.

A function from messages to a text is a model too.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast, runtime_checkable

from lare_rl.errors import LareError, short_repr
from lare_rl.llm.key import redact_key
from lare_rl.llm.prompts import FunctionKind, Message
from lare_rl.llm.recording import RecordedModel, read_recording, shipped_recordings
from lare_rl.util.safe_io import read_text
from lare_rl.util.sanitize import replace_surrogates

__all__ = ["FunctionModel", "Model", "ModelFunction", "as_model", "ask", "recorded_model"]


@runtime_checkable
class Model(Protocol):
    """A language model."""

    @property
    def name(self) -> str:
        """The name that is saved with `phi`, as that of the model that wrote it."""
        ...

    def reply(self, messages: Sequence[Message], number: int) -> str:
        """Return the text of a reply. `number` counts the replies to the same request: 0, 1, ...

        Raises `LareError` if there is no reply.
        """
        ...


ModelFunction = Callable[[list[Message]], str]
"""Takes the messages of a request, each with `role` and `content`, and returns the text of the reply."""


@dataclass(frozen=True)
class FunctionModel:
    """A model that calls a function."""

    function: ModelFunction
    name: str

    def reply(self, messages: Sequence[Message], number: int) -> str:
        return self.function([dict(message) for message in messages])


def ask(model: Model, messages: Sequence[Message], number: int = 0) -> str:
    """Return a model's reply, which a file can store.

    Raises `LareError` for any error of the model, and if the reply is no text. A caller that catches it keeps the earlier replies, which
    were paid for.
    """
    try:
        text: object = model.reply(messages, number)
    except LareError:
        raise
    except Exception as error:
        raise LareError(redact_key(f"the model {model.name} failed: {type(error).__name__}: {error}")) from error
    if not isinstance(text, str):
        raise LareError(f"the model {model.name} must return a text, and returned {short_repr(text)}")
    return redact_key(replace_surrogates(text))


def as_model(model: Any) -> Model:
    """Return a model unchanged, and a function as a `FunctionModel`. Raises `LareError` for anything else."""
    if isinstance(model, Model):
        if isinstance(model.name, str):
            return model
    elif callable(model):
        return FunctionModel(cast(ModelFunction, model), getattr(model, "__name__", type(model).__name__))
    raise LareError(
        "a model must be a function from messages to a text, or have a name (a text) and a method reply(messages, number), as "
        f"lare_rl.llm.live.LiveModel('NAME') has: {short_repr(model)} does not"
    )


def recorded_model(task: str, kind: FunctionKind, draw: int = 0, path: Path | None = None) -> RecordedModel:
    """Return a model that answers from a file or, without one, from the shipped recordings of that kind and draw.

    Raises `LareError` if the file or draw does not exist, or the file is not a recording.
    """
    if path is None:
        return RecordedModel(shipped_recordings(kind, draw), task)
    try:
        text = read_text(path)
    except LareError as error:
        raise LareError(f"the recording {error}") from error
    return RecordedModel([read_recording(text, str(path))], task)
