"""A phi over turns: reading, checks, the request, the design, and the two tool sets."""

from pathlib import Path

import pytest

import lare_rl
from helpers.scripted_model import ScriptedModel, to_reply
from lare_rl.errors import LareError
from lare_rl.llm.recording import SHIPPED_RECORDINGS, RecordedModel, read_recording
from lare_rl.turns.design import design_turn_phi, turn_request
from lare_rl.turns.messages import Call, Turn
from lare_rl.turns.phi import find_problems, load_turn_phi, read_turn_phi
from lare_rl.turns.tool_sets import TOOL_SETS, load_tool_set

ROOT = Path(__file__).parents[2]
SOURCE = (
    "def turn_events(tool, arguments, result, text):\n    return {'passes': 'passed' in result, 'n': len(arguments)}\n"
)
PASSED = Turn("", (Call("test", '{"a": 1}', "3 passed", False), Call("test", "not JSON", "2 passed", False)), "")
FAILED = Turn("I give up", (), "")


def test_events_of_calls_add_up():
    assert read_turn_phi(SOURCE)(PASSED) == {"passes": 2, "n": 2}
    assert read_turn_phi(SOURCE)(FAILED) == {"passes": 0, "n": 0}


OTHER_NAMES = "def turn_events(tool, arguments, result, text):\n    return {'a' if 'a' in arguments else 'b': 1}\n"


def test_calls_of_a_turn_have_the_same_events():
    assert find_problems(read_turn_phi(OTHER_NAMES), [PASSED, FAILED]).startswith(
        "E-NAMES call 2: the events are not those of call 1 (a, b)"
    )
    calls = [{"function": {"name": "test", "arguments": arguments}} for arguments in ('{"a": 1}', "{}")]
    messages = [{"role": "assistant", "content": "I look."}, {"role": "assistant", "tool_calls": calls}]
    with pytest.raises(LareError, match="rollout 0, turn 1: phi failed: E-NAMES call 2"):
        lare_rl.TurnCredit(phi=read_turn_phi(OTHER_NAMES))([{"messages": messages, "outcome": 1}])


def test_credit_uses_the_events():
    messages = [
        {"role": "assistant", "tool_calls": [{"id": "1", "function": {"name": "test", "arguments": "{}"}}]},
        {"role": "tool", "tool_call_id": "1", "content": "3 passed"},
        {"role": "assistant", "content": "Done."},
    ]
    bad = [*messages[:1], {**messages[1], "content": "3 failed"}, messages[2]]
    rollouts = [{"messages": messages if k % 2 else bad, "outcome": k % 2, "group": k // 4} for k in range(40)]
    result = lare_rl.TurnCredit(phi=read_turn_phi(SOURCE))(rollouts)
    effects = {effect.name: effect.first for effect in result.effects}
    assert effects["passes"] > 0.3
    with pytest.raises(LareError, match="no messages"):
        lare_rl.TurnCredit(phi=read_turn_phi(SOURCE))([{"turns": [{}], "outcome": 1}])


@pytest.mark.parametrize(
    ("source", "words"),
    [
        (SOURCE.replace("len(arguments)", "1 / len(arguments)"), ["E-RUN"]),
        (
            "def turn_events(tool, arguments, result, text):\n    return {'a' if tool else 'b': 1}\n",
            ["E-NAMES", "a, b"],
        ),
        ("def turn_events(tool, arguments, result, text):\n    return {'a': 1}\n", ["E-CONSTANT"]),
    ],
)
def test_problems(source, words):
    problems = find_problems(read_turn_phi(source), [Turn("", PASSED.calls[:1], ""), FAILED])
    assert all(word in problems for word in words), problems
    assert find_problems(read_turn_phi(SOURCE), [PASSED, FAILED]) == ""


def test_files(tmp_path):
    path = tmp_path / "phi.py"
    path.write_text(SOURCE)
    assert load_turn_phi(path).source == SOURCE
    for source in ("x = 1", "# def turn_events\nx = 1", "turn_events = 1"):
        path.write_text(source)
        with pytest.raises(LareError, match=f"{path}: not a valid turn function: .*turn_events"):
            load_turn_phi(path)


ALIAS = "turn_events = f\n"
RAISE = "def turn_events(tool, arguments, result, text):\n    if text:\n        raise ValueError(text)\n    return {'a': 1}\n"


def test_design_corrects_until_a_program_passes(tmp_path):
    replies = [
        to_reply(source) for source in ("x = 1", SOURCE.replace("def turn_events", "def f") + ALIAS, RAISE, SOURCE)
    ]
    model = ScriptedModel(replies=["no JSON", *replies])
    path = tmp_path / "record.json"
    half = Turn("\ud83d", (), "")  # half of a surrogate pair, which no file can hold
    phi = design_turn_phi("\ud83d", [{"name": "test"}], [PASSED, half], model, record=path)
    assert phi.source.strip() == SOURCE.strip()
    assert "not one JSON object" in model.requests[1][-1]["content"]
    assert "E-FORM" in model.requests[2][-1]["content"]
    assert "no function turn_events" in model.requests[3][-1]["content"]
    assert "ValueError: ?" in model.requests[4][-1]["content"]
    exchanges = read_recording(path.read_text(encoding="utf-8"), path.name).exchanges
    assert [exchange.stage for exchange in exchanges] == ["candidate", *["correct"] * 4]


def test_request_has_tools_and_turns():
    system, user = turn_request("Repair it.", [{"function": {"name": "test", "description": "Run."}}], [PASSED])
    assert "find_numbers" in system["content"]
    assert all(text in user["content"] for text in ("Repair it.", "## test\nRun.", '"3 passed"', "not JSON"))
    assert "## test\n\nParameters: {}" in turn_request("", [{"name": "test", "description": None}], [])[1]["content"]
    for tool, message in (({}, "function with a name"), ({"name": "f", "parameters": {1j}}, "JSON")):
        with pytest.raises(LareError, match=message):
            turn_request("Repair it.", [tool], [])


@pytest.mark.parametrize("name", TOOL_SETS)
def test_tool_sets_and_their_recorded_replies(name):
    tool_set = load_tool_set(name)
    assert len(tool_set.examples) == 5
    phi = load_turn_phi(ROOT / "examples" / "phi" / f"turns_{name}.py")
    assert find_problems(phi, tool_set.turns) == ""
    path = SHIPPED_RECORDINGS / "events" / f"{name}.draw0.json"
    recording = read_recording(path.read_text(encoding="utf-8"), path.name)
    model = RecordedModel([recording], name)
    phi = design_turn_phi(tool_set.goal, tool_set.tools, tool_set.turns, model, examples=tool_set.examples)
    assert phi.model == f"{recording.model}, recorded {recording.recorded}, draw {recording.draw}"
