"""A language model whose replies are written in advance."""

import json

from lare_rl.errors import LareError


def to_reply(source: str) -> str:
    """Return the reply whose function has this source."""
    return json.dumps({"Understand": "", "Analyze": "", "Functions": source})


class ScriptedModel:
    """Replies with one function after the other, and then with some texts. When none is left, it raises an error."""

    name = "scripted"

    def __init__(self, *sources, replies=(), error: BaseException | None = None):
        self.replies = [*map(to_reply, sources), *replies]
        self.error = error or LareError("no reply is left")
        self.requests, self.numbers = [], []

    def reply(self, messages, number):
        self.requests.append(messages)
        self.numbers.append(number)
        if not self.replies:
            raise self.error
        return self.replies.pop(0)
