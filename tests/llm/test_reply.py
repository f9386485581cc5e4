"""Reading a reply: any text is a reply or a malformed one."""

import contextlib
import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lare_rl.llm.reply import MalformedReply, Reply, parse

GOOD = {"Understand": "u", "Analyze": "a", "Functions": "def f(): ..."}


def test_a_reply_is_read():
    reply = parse(f"\n {json.dumps(GOOD | {'Notes': 'more than was asked for'}, indent=1)} \n")
    assert (reply.understand, reply.analyze, reply.functions) == ("u", "a", "def f(): ...")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the reply is empty"),
        (" \n", "the reply is empty"),
        ("x" * 200_001, "the reply has 200001 characters; at most 200000 are read"),
        ("Here it is.", "the reply is not one JSON object: Expecting value: line 1 column 1 (char 0)"),
        ("```json\n{}\n```", "the reply is not one JSON object: Expecting value: line 1 column 1 (char 0)"),
        ("{} {}", "the reply is not one JSON object: Extra data: line 1 column 4 (char 3)"),
        ('{"Understand": "u"', "the reply is not one JSON object: Expecting ',' delimiter: line 1 column 19 (char 18)"),
        (
            '{"a": "\n"}',
            "the reply's JSON object is not as asked for: the keys 'Understand', 'Analyze', 'Functions' are missing",
        ),
        ("[]", "the reply is JSON, but not an object: '[]'"),
        ("null", "the reply is JSON, but not an object: 'null'"),
        (json.dumps("x" * 99), "the reply is JSON, but not an object: '\"" + "x" * 39 + "'"),
        (
            "{}",
            "the reply's JSON object is not as asked for: the keys 'Understand', 'Analyze', 'Functions' are missing",
        ),
        (
            '{"Understand": "u", "Analyze": "a", "functions": "f"}',
            "the reply's JSON object is not as asked for: the key 'Functions' is missing",
        ),
        (
            json.dumps(GOOD | {"Functions": ""}),
            "the reply's JSON object is not as asked for: Functions = '': string should have at least 1 character",
        ),
        (
            json.dumps(GOOD | {"Functions": ["def f(): ..."]}),
            "the reply's JSON object is not as asked for: Functions = ['def f(): ...']: input should be a valid string",
        ),
        (
            json.dumps(GOOD | {"Analyze": None}),
            "the reply's JSON object is not as asked for: Analyze = None: input should be a valid string",
        ),
    ],
)
def test_a_malformed_reply_says_what_is_wrong(text, message):
    with pytest.raises(MalformedReply) as error:
        parse(text)
    assert str(error.value) == message


CODE = "def evaluation_func(observation, action):\n    return [action]"


@pytest.mark.parametrize(
    ("text", "understood"),
    [
        (f"```json\n{json.dumps(GOOD | {'Functions': CODE})}\n```", "u"),
        (f"Sure! {{a: b}} Here it is:\n{json.dumps(GOOD | {'Functions': CODE})}\nI hope {{that}} helps.", "u"),
        (json.dumps(GOOD | {"Functions": f"```python\n{CODE}\n```"}), "u"),
        (f"The cart moves.\n```python\n{CODE}\n```\nThat is all.", "The cart moves.\n"),
        (f"First:\n```sh\npip install numpy\n```\n```\n{CODE}\n```", "First:\n```sh\npip install numpy\n```\n"),
        (json.dumps(GOOD | {"Functions": f"```python3\n{CODE}\n```"}), "u"),
        (json.dumps(GOOD | {"Functions": CODE}).replace("\\n", "\n"), "u"),
        (f"<think>As {json.dumps(GOOD)}?</think>\n{json.dumps(GOOD | {'Functions': CODE})}", "u"),
        (f"```\n{GOOD['Functions']}\n```\nNo.</thinking>\n```\n{CODE}\n```", "\n"),
        (json.dumps(GOOD | {"Understand": "</think>", "Functions": CODE}), "</think>"),
        (f"A draft: {json.dumps(GOOD)}, or better: {json.dumps(GOOD | {'Functions': CODE})}", "u"),
        (f'First {{"Functions": "draft"}}, then {json.dumps(GOOD | {"Functions": CODE})}, {{"Functions": "x"}}', "u"),
        ("{}" * 150 + json.dumps(GOOD | {"Functions": CODE}), "u"),
    ],
)
def test_a_reply_is_found_among_other_words(text, understood):
    reply = parse(text)
    assert (reply.understand, reply.functions.strip()) == (understood, CODE)


def test_a_fence_in_a_docstring_is_no_function():
    source = 'def evaluation_func(observation, action):\n    """Scores.\n    ```\n    x = 1\n    ```\n    """\n    return [action]'
    assert parse(json.dumps(GOOD | {"Functions": source})).functions == source


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from([*GOOD, "More"]) | st.text(), inner),
    max_leaves=8,
)


@settings(deadline=None)
@given(st.text() | st.builds(json.dumps, JSON))
def test_any_text_is_a_reply_or_a_malformed_one(text):
    with contextlib.suppress(MalformedReply):
        assert parse(text).functions


@settings(deadline=None)
@given(st.fixed_dictionaries({"Understand": st.text(), "Analyze": st.text(), "Functions": st.text(min_size=1)}))
def test_what_is_as_asked_for_is_read_unchanged(values):
    assert parse(json.dumps(values)) == Reply(**values)


@pytest.mark.parametrize(
    "text",
    [
        "```" + "\t" * 190_000,
        "<think>" * 28_000,
        '{ "' * 60_000,
        "[" * 100_000,
        '{"self": 1}',
        '{"Understand": "u", "Analyze": "a", "Functions": ""}',
    ],
)
def test_what_once_broke_the_parser(text):
    with pytest.raises(MalformedReply):
        parse(text)
