"""Programs over turns: what they may do, what is refused, and that nothing of them runs as Python."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lare_rl.phi.limits import MAX_TEXT_LENGTH, RefusedError
from lare_rl.phi.turn_program import parse_turn_program, read_events, shorten

HEAD = "def turn_events(tool, arguments, result, text):\n"


def events(body, tool="test", arguments=None, result="3 failed, 25 passed in 1.5s", text="I run the tests."):
    return read_events(parse_turn_program(HEAD + body), tool, arguments or {}, result, text)


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("'failed' in result", 1.0),
        ("len(result.split())", 6.0),
        ("find_numbers(result)[0]", 3.0),
        ("sum(find_numbers('-1.5, +2, v3, 4.25.6 7s'))", 11.75),
        ("sum(find_numbers('loss 1e-3, 2.5E2 of 3e 1e400'[:-6] + ' .5'))", 253.501),
        ("find_numbers('1e400')[0] / 1e300", 1.0),
        ("min(float(find_numbers(result)[1]), 20)", 20.0),
        ("text.lower().count('t')", 3.0),
        ("any(word.isdigit() for word in result.split())", 1.0),
    ],
)
def test_operations_on_texts(expression, value):
    assert events(f"    return {{'event': {expression}}}\n") == {"event": value}


def test_arguments_are_copied():
    arguments = {"path": "a.py", "lines": [1, 2.5, {"deep": {"er": {"est": [1]}}}], "flag": True, "n": 10**300}
    body = "    return {'n': len(arguments['lines']), 'path': arguments['path'] == 'a.py', 'flag': arguments['flag']}\n"
    assert events(body, arguments=arguments) == {"n": 3, "path": 1, "flag": 1}


def test_nothing_is_kept_between_calls():
    tree = parse_turn_program("seen = []\n" + HEAD + "    seen.append(tool)\n    return {'seen': len(seen)}\n")
    assert [read_events(tree, "a", {}, "", "")["seen"] for _ in range(3)] == [1, 1, 1]


def test_long_texts_are_shortened_in_the_middle():
    text = "a" * 20_000 + "b" * 20_000
    short = shorten(text)
    assert len(short) <= MAX_TEXT_LENGTH
    assert short[0] == "a"
    assert short[-1] == "b"
    assert "left out" in short
    assert shorten("short") == "short"
    assert events("    return {'end': result.endswith('b'), 'low': 'a' in result.lower()}\n", result=text) == {
        "end": 1,
        "low": 1,
    }


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("x = 1\n", ["E-FORM", "turn_events(tool, arguments, result, text)"]),
        (HEAD + "    return [1]\n", ["E-FORM", "dictionary", "a list"]),
        (HEAD + "    return {3: 1}\n", ["E-FORM", "text"]),
        (HEAD + "    return {'a': 'b'}\n", ["E-FORM", "'a'", "number"]),
        (HEAD + "    return {'a': float('nan')}\n", ["E-FORM", "'a'"]),
        (HEAD + "    return {'a': arguments['missing']}\n", ["E-RUN", "line 2", "missing"]),
        (HEAD + "    return {'a': find_numbers(3)}\n", ["E-RUN", "find_numbers takes a text"]),
        (HEAD + "    return {'a': open('x')}\n", ["E-PYTHON", "open"]),
        ("import re\n" + HEAD + "    return {'a': 1}\n", ["E-IMPORT", "re"]),
        (HEAD + "    while True:\n        pass\n", ["E-COST", "steps"]),
        (HEAD + "    x = result\n    while True:\n        x = x + x\n", ["E-COST"]),
        (HEAD + "    return {'a': tool.__class__}\n", ["E-ATTRIBUTE"]),
        (HEAD + "    return {'a': turn_events(tool, arguments, result, text)}\n", ["E-"]),
        ("def turn_events(:\n", ["E-SYNTAX", "line 1"]),
    ],
)
def test_refusals(source, words):
    with pytest.raises(RefusedError) as error:
        read_events(parse_turn_program(source), "test", {}, "ok", "")
    assert all(word in str(error.value) for word in words), str(error.value)
    assert "\n" not in str(error.value)


PIECES = st.sampled_from(
    "tool arguments result text . ( ) [ ] { } : , 'a' \"b\" 1 2.5 -1 + * / == < in not and or if else for lambda lower() split() "
    "find_numbers len sum max str int float get('x') [0] [-1] [1:] ** None True return".split()
)


@settings(max_examples=150, deadline=None)
@given(
    st.lists(PIECES, max_size=14), st.text(max_size=30), st.dictionaries(st.text(max_size=3), st.floats() | st.text())
)
def test_any_program_gives_numbers_or_a_refusal(pieces, result, arguments):
    source = HEAD + f"    return {{'a': {' '.join(pieces)}}}\n"
    refusal, values = "", {}
    try:
        values = read_events(parse_turn_program(source), "test", arguments, result, "")
    except RefusedError as error:
        refusal = str(error)
    assert "E-BUG" not in refusal
    assert all(abs(value) <= 1e6 for value in values.values())
