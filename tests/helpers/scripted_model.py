"""A language model whose replies are written in advance."""

import json

from lare_rl.errors import LareError


def to_reply(source: str) -> str:
    """Return the reply whose function has this source."""
    return json.dumps({"Understand": "", "Analyze": "", "Functions": source})


class ScriptedModel:
    """Replies with one function after the other. When none is left, it raises `LareError`."""

    name = "scripted"

    def __init__(self, *sources):
        self.replies = list(map(to_reply, sources))
        self.requests = []

    def reply(self, messages, sample):
        self.requests.append(messages)
        if not self.replies:
            raise LareError("no reply is left")
        return self.replies.pop(0)
