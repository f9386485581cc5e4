"""Turns in messages, in the form of OpenAI's chat completions, and their features without any knowledge of the task.

| feature | |
|---|---|
| `call NAME` | calls of the tool |
| `NAME fails` | of these calls, those whose result looks like an error |
| `repeats a call` | calls with the name and the arguments of an earlier one in the same rollout |
| `repeats a result` | results with the text of an earlier one in the same rollout |
| `no tool` | 1 if no tool is called |
| `tokens` | the length of the assistant's message, in hundreds of tokens of four characters |
"""

import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from lare_rl.errors import LareError, short_repr
from lare_rl.util.safe_io import read_json
from lare_rl.util.sanitize import one_line

__all__ = [
    "Call",
    "Turn",
    "check_list",
    "looks_like_error",
    "message_features",
    "read_function",
    "split_turns",
    "to_json",
]

MAX_MESSAGES = 20_000
MAX_CALLS = 64
"""The largest number of calls in a turn."""
MAX_TOOL_NAME = 60
CHARACTERS_PER_TOKEN, TOKENS_UNIT = 4, 100
"""The feature `tokens` is an estimate, in the unit of 100 tokens."""


@dataclass(frozen=True)
class Call:
    """A call of a tool, and its result."""

    tool: str
    arguments: str
    """As the assistant wrote them: usually JSON."""
    result: str
    failed: bool


@dataclass(frozen=True)
class Turn:
    """An assistant's message with the messages that answer it."""

    text: str
    """What the assistant says, without its calls."""
    calls: tuple[Call, ...]
    reply: str
    """The texts of the answers that are not results of calls, such as those of a game that speaks as the user."""


def check_list(values: Any, name: str, limit: int, where: str) -> None:
    """Raise `LareError` if a value of a rollout is no list, or has more than `limit` entries."""
    if not isinstance(values, Sequence) or isinstance(values, str | bytes):
        raise LareError(f"{where}: {name} must be a list, and is {short_repr(values)}")
    if len(values) > limit:
        raise LareError(f"{where} has {len(values)} {name}: at most {limit} are accepted")


def split_turns(messages: Any, where: str) -> list[Turn]:
    """Return the turns of a conversation. What comes before the assistant's first message is ignored.

    Raises:
        LareError: a message is malformed.
    """
    check_list(messages, "messages", MAX_MESSAGES, where)
    spans: list[list[tuple[int, Mapping[str, Any]]]] = []
    for i, message in enumerate(messages):
        if not isinstance(message, Mapping) or not isinstance(message.get("role"), str):
            raise LareError(f"{where}: messages[{i}] must be a mapping with a role, and is {short_repr(message)}")
        if message["role"] == "assistant":
            spans.append([])
        if spans:
            spans[-1].append((i, message))
    return [_read_turn(span, where) for span in spans]


class _Result(NamedTuple):
    """A tool's message."""

    identifier: str | int | None
    text: str
    failed: bool


def _read_turn(span: Sequence[tuple[int, Mapping[str, Any]]], where: str) -> Turn:
    i, message = span[0]
    calls = _read_calls(message, f"{where}: messages[{i}]")
    results, replies = [], []
    for j, answer in span[1:]:
        text = _read_text(answer.get("content"), f"{where}: messages[{j}]")
        if answer["role"] == "tool":
            results.append(_Result(_read_identifier(answer.get("tool_call_id")), text, _failed(answer, text)))
        else:
            replies.append(text)
    calls += [(None, "unknown", "")] * (len(results) - len(calls))
    matched = _match_results([identifier for identifier, _, _ in calls], results)
    return Turn(
        text=_read_text(message.get("content"), f"{where}: messages[{i}]"),
        calls=tuple(
            Call(tool, arguments, result.text, result.failed)
            for (_, tool, arguments), result in zip(calls, matched, strict=True)
        ),
        reply="\n".join(replies),
    )


def _match_results(identifiers: Sequence[str | int | None], results: Sequence[_Result]) -> list[_Result]:
    """Return the result of each call: that with its identifier, or else the next that has the identifier of no call."""
    remaining = list(results)
    matched = []
    for identifier in identifiers:
        same = () if identifier is None else (result for result in remaining if result.identifier == identifier)
        if result := next(iter(same), None):
            remaining.remove(result)
        matched.append(result)
    rest = iter(remaining)
    return [result or next(rest, _Result(None, "", False)) for result in matched]


def _read_calls(message: Mapping[str, Any], where: str) -> list[tuple[str | int | None, str, str]]:
    """Return the identifier, the name and the arguments of each call of an assistant's message."""
    calls = message.get("tool_calls")
    if calls is None:
        return []
    check_list(calls, "tool_calls", MAX_CALLS, where)
    result = []
    for k, call in enumerate(calls):
        function = read_function(call, f"{where}: tool_calls[{k}]")
        arguments = function.get("arguments", "")
        if not isinstance(arguments, str):
            arguments = to_json(arguments, f"{where}: the arguments of tool_calls[{k}]")
        result.append((_read_identifier(call.get("id")), one_line(function["name"])[:MAX_TOOL_NAME], arguments))
    return result


def _read_identifier(value: Any) -> str | int | None:
    return value if isinstance(value, str | int) else None


def read_function(value: Any, where: str) -> Mapping[str, Any]:
    """Return the function of a tool or of a call. Raises `LareError` if it has no name."""
    function = value.get("function", value) if isinstance(value, Mapping) else None
    name = function.get("name") if isinstance(function, Mapping) else None
    if not isinstance(function, Mapping) or not isinstance(name, str) or not name.strip():
        raise LareError(f"{where} must have a function with a name, and is {short_repr(value)}")
    return function


def to_json(values: Any, name: str, ensure_ascii: bool = True) -> str:
    """Write values as JSON. Raises `LareError` if they have others than JSON has."""
    try:
        return json.dumps(values, sort_keys=True, ensure_ascii=ensure_ascii)
    except (TypeError, ValueError, RecursionError):
        raise LareError(f"{name} are not JSON: {short_repr(values)}") from None


def _read_text(content: Any, where: str) -> str:
    """Return the text of a message: a string, or a list of parts with texts. Images and the like are ignored."""
    if content is None:
        return ""
    if isinstance(content, str):
        return content
    if not isinstance(content, Sequence) or isinstance(content, bytes):
        raise LareError(f"{where}: content must be a text or a list of parts, and is {short_repr(content)}")
    texts = (item.get("text") if isinstance(item, Mapping) else item for item in content)
    return "\n".join(text for text in texts if isinstance(text, str))


def _failed(answer: Mapping[str, Any], text: str) -> bool:
    """Return whether a tool's message reports an error."""
    flag = answer.get("is_error")
    if isinstance(flag, bool):
        return flag
    return answer.get("status") == "error" or looks_like_error(text)


def looks_like_error(text: str) -> bool:
    """Return whether a tool's result begins like an error, has a traceback, or is a JSON object with an `error`."""
    start = text[:10_000].strip().lower()
    if start.startswith(("error", "exception", "fatal", "traceback")) or "traceback (most recent call last)" in start:
        return True
    if start.startswith("{") and '"error"' in start:
        try:
            value = read_json(text)
        except ValueError:
            return False
        return isinstance(value, dict) and bool(value.get("error"))
    return False


def message_features(turns: Sequence[Turn]) -> list[dict[str, float]]:
    """Return the features of the turns of one rollout that need no knowledge of the task."""
    earlier_calls: set[tuple[str, str]] = set()
    earlier_results: set[str] = set()
    rows = []
    for turn in turns:
        row: defaultdict[str, float] = defaultdict(float)
        for call in turn.calls:
            row[f"call {call.tool}"] += 1
            row[f"{call.tool} fails"] += call.failed
            row["repeats a call"] += (call.tool, call.arguments) in earlier_calls
            earlier_calls.add((call.tool, call.arguments))
        for result in [*(call.result for call in turn.calls), turn.reply]:
            if result:
                row["repeats a result"] += result in earlier_results
                earlier_results.add(result)
        row["no tool"] = not turn.calls
        length = len(turn.text) + sum(len(call.tool) + len(call.arguments) for call in turn.calls)
        row["tokens"] = length / CHARACTERS_PER_TOKEN / TOKENS_UNIT
        rows.append({name: float(value) for name, value in row.items()})
    return rows
