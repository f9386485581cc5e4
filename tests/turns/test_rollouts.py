"""How rollouts are read: features of messages, bad inputs by what the message must contain, foreign input."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import lare_rl
from lare_rl.errors import LareError
from lare_rl.turns.features import MAX_FEATURES, tabulate
from lare_rl.turns.messages import looks_like_error, split_turns
from lare_rl.turns.rollouts import read_rollout, read_rollouts


def call(name, arguments="{}", identifier="1"):
    return {"id": identifier, "type": "function", "function": {"name": name, "arguments": arguments}}


def assistant(text="", *calls):
    return {"role": "assistant", "content": text} | ({"tool_calls": list(calls)} if calls else {})


def tool(text, identifier="1"):
    return {"role": "tool", "tool_call_id": identifier, "content": text}


MESSAGES = [
    {"role": "system", "content": "You repair programs."},
    {"role": "user", "content": "Repair it."},
    assistant("Let me see.", call("read", '{"file": "a.py"}')),
    tool("def f(): pass"),
    assistant("", call("test", "{}", "1"), call("read", '{"file": "a.py"}', "2")),
    tool("def f(): pass", "2"),  # results may come in any order
    tool("Traceback (most recent call last): ...", "1"),
    assistant("Done."),
]


def test_features_of_messages():
    rollout = read_rollout({"messages": MESSAGES, "outcome": 1}, "it")
    first, second, third = rollout.turns
    assert first["call read"] == 1
    assert first["repeats a call"] == first["repeats a result"] == first["no tool"] == 0
    assert first["tokens"] == pytest.approx((len("Let me see.") + len("read") + len('{"file": "a.py"}')) / 400)
    assert second["test fails"] == 1
    assert second["read fails"] == 0
    assert second["repeats a call"] == second["repeats a result"] == 1
    assert third["no tool"] == 1


def test_results_without_identifier_follow_the_order_of_calls():
    calls = [call(name, identifier=k) for k, name in enumerate("abc")]
    for results in (["a", "b", "c"], [tool("b", 1), "a", "c"]):
        answers = [result if isinstance(result, dict) else {"role": "tool", "content": result} for result in results]
        (turn,) = split_turns([assistant("", *calls), *answers], "it")
        assert [answered.result for answered in turn.calls] == ["a", "b", "c"]


def test_results_with_the_same_identifier_follow_the_order_of_calls():
    """Some servers give all calls the same identifier, such as an empty one."""
    messages = [assistant("", call("a", identifier=""), call("b", identifier="")), tool("a", ""), tool("b", "")]
    (turn,) = split_turns(messages, "it")
    assert [answered.result for answered in turn.calls] == ["a", "b"]


@pytest.mark.parametrize("events", [3, {"": 1}, {"event": float("nan")}, {"event": 1e200}, {"event": "y"}])
def test_results_of_a_phi_are_checked(events):
    with pytest.raises(LareError, match=r"it: .* phi .* turn 0") as error:
        read_rollout({"messages": MESSAGES, "outcome": 1}, "it", lambda turn: events)
    assert "turns[" not in str(error.value)


def test_phi_that_fails():
    with pytest.raises(LareError, match=r"^rollout 1, turn 2: .*KeyError: 'a'$"):
        read_rollouts(
            [{"messages": messages, "outcome": 1} for messages in (MESSAGES[:-1], MESSAGES)],
            lambda turn: {} if turn.calls else {}["a"],
        )


def test_numbers_of_numpy():
    plain = {"turns": [{"a": 1}], "outcome": 1, "group": 3, "truncated": True}
    numpy = {"turns": [{"a": np.int8(1)}], "outcome": np.float32(1), "group": np.int64(3), "truncated": np.bool_(True)}
    (rollout,) = read_rollouts([numpy])
    assert read_rollouts([plain]) == [rollout]
    assert type(rollout.truncated) is bool
    with pytest.raises(LareError, match="group"):
        read_rollouts([plain | {"group": np.bool_(True)}])


def test_replies_of_the_user_belong_to_the_turn():
    messages = [assistant("open door"), {"role": "user", "content": "It is locked."}] * 2
    assert [turn.reply for turn in split_turns(messages, "it")] == ["It is locked."] * 2
    rollout = read_rollout({"messages": messages, "outcome": 0}, "it")
    assert [turn["repeats a result"] for turn in rollout.turns] == [0, 1]


def test_numbers_of_the_user_come_on_top_and_win():
    numbers = [{"tests pass": 1, "tokens": 7}, {}, {}]
    rollout = read_rollout({"messages": MESSAGES, "turns": numbers, "outcome": 1}, "it")
    assert [rollout.turns[0][name] for name in ("tests pass", "tokens", "call read")] == [1, 7, 1]
    rollout = read_rollout({"messages": MESSAGES, "turns": numbers, "outcome": 1}, "it", lambda turn: {"tokens": 5})
    assert [row["tokens"] for row in rollout.turns] == [7, 5, 5]


@pytest.mark.parametrize(
    ("text", "failed"),
    [
        ("Error: no such file", True),
        ("ran 3 tests\nTraceback (most recent call last):\n", True),
        ('{"error": "no such city"}', True),
        ('{"error": null, "value": 3}', False),
        ("0 errors", False),
        ("", False),
        ("{" * 500, False),
    ],
)
def test_results_that_look_like_errors(text, failed):
    assert looks_like_error(text) == failed


def test_only_the_most_frequent_features_are_used():
    turns = [{"often": 1, f"name {i}": 1} for i in range(3 * MAX_FEATURES)]
    table = tabulate(read_rollouts([{"turns": turns, "outcome": 0}]))
    assert len(table.names) == MAX_FEATURES
    assert "often" in table.names


class Tensor:
    """Several numbers, which PyTorch refuses to convert into one."""

    def __float__(self):
        raise RuntimeError("a Tensor with 2 elements cannot be converted to Scalar")


OUTCOME = {"outcome": 1}
BAD = [
    (3, ["rollout 0", "mapping", "3"]),
    ({"outcome": Tensor()}, ["outcome", "Tensor"]),
    ({"outcome": "good"}, ["outcome", "'good'"]),
    ({"outcome": float("nan")}, ["outcome", "nan"]),
    ({"outcome": 1e300}, ["outcome", "1e+09"]),
    (OUTCOME, ["neither messages nor turns"]),
    ({**OUTCOME, "turns": []}, ["has no turn"]),
    ({**OUTCOME, "turns": [3]}, ["turns[0]", "3"]),
    ({**OUTCOME, "turns": [{"a": "b"}]}, ["turns[0]", "'a'", "'b'"]),
    ({**OUTCOME, "turns": [{"a": float("inf")}]}, ["turns[0]", "'a'", "inf"]),
    ({**OUTCOME, "turns": [{"a\nb": 1}]}, ["turns[0]", "line breaks"]),
    ({**OUTCOME, "turns": [{}], "group": [1]}, ["group", "[1]"]),
    ({**OUTCOME, "turns": [{}], "truncated": "no"}, ["truncated", "'no'"]),
    ({**OUTCOME, "messages": [3]}, ["messages[0]", "role"]),
    ({**OUTCOME, "messages": [{"role": "user", "content": "hi"}]}, ["no message", "assistant"]),
    ({**OUTCOME, "messages": [{"role": "assistant", "content": 3}]}, ["messages[0]", "content", "3"]),
    ({**OUTCOME, "messages": [{"role": "assistant", "tool_calls": [{}]}]}, ["tool_calls[0]", "name"]),
    ({**OUTCOME, "messages": MESSAGES, "turns": [{}]}, ["3 messages of the assistant", "turns has 1"]),
]


@pytest.mark.parametrize(("rollout", "words"), BAD, ids=range(len(BAD)))
def test_bad_rollouts(rollout, words):
    with pytest.raises(LareError) as error:
        read_rollouts([rollout])
    assert all(word in str(error.value) for word in words), str(error.value)
    assert "\n" not in str(error.value)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)
ROLES = st.sampled_from(["assistant", "tool", "user", "system"]) | VALUES
MESSAGE = st.fixed_dictionaries(
    {"role": ROLES}, optional={"content": VALUES, "tool_calls": VALUES | st.lists(VALUES), "tool_call_id": VALUES}
)
ROLLOUT = st.fixed_dictionaries(
    {"outcome": st.floats(-2, 2) | VALUES},
    optional={
        "messages": st.lists(MESSAGE | VALUES, max_size=5) | VALUES,
        "turns": st.lists(st.dictionaries(st.text(max_size=3), st.floats(-1e9, 1e9), max_size=3) | VALUES, max_size=5),
        "group": st.text(max_size=2) | VALUES,
        "truncated": st.booleans() | VALUES,
    },
)


@settings(max_examples=120, deadline=None)
@given(st.lists(ROLLOUT | VALUES, max_size=4))
def test_foreign_rollouts_give_numbers_or_one_line(rollouts):
    message, result = "", None
    try:
        result = lare_rl.TurnCredit()(rollouts)
    except LareError as error:
        message = str(error)
    assert "\n" not in message
    if result is None:
        return
    assert len(result.advantage) == len(rollouts)
    assert np.isfinite(np.concatenate([*result.advantage, *result.progress, *result.deviation])).all()
    json.dumps(result.words)


NUMBERS = st.dictionaries(st.sampled_from("abc"), st.floats(-1e9, 1e9) | st.sampled_from([0.0, 1.0]), max_size=3)


@settings(max_examples=30, deadline=None)
@given(
    st.lists(
        st.tuples(st.lists(NUMBERS, min_size=1, max_size=6), st.floats(-1e6, 1e6), st.integers(0, 3)),
        min_size=1,
        max_size=12,
    )
)
def test_any_numbers_give_exact_sums(rollouts):
    outcomes = [outcome for _, outcome, _ in rollouts]
    result = lare_rl.TurnCredit(0.8)(
        [{"turns": turns, "outcome": outcome, "group": group} for turns, outcome, group in rollouts]
    )
    scale = 1 + max(map(abs, outcomes))
    for outcome, progress, value in zip(outcomes, result.progress, result.value, strict=True):
        assert np.isfinite(value).all()
        assert progress.sum() == pytest.approx(outcome - value[0], abs=1e-6 * scale)
