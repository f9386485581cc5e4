"""Reading a reply: every text is a reply or a malformed one."""

import contextlib
import json
import textwrap

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lare_rl.llm.reply import MalformedReplyError, Reply, parse_reply

GOOD = {"Understand": "u", "Analyze": "a", "Functions": "def f(): ..."}
CODE = "def evaluation_func(observation, action):\n    return [action]"
WITH_CODE = GOOD | {"Functions": CODE}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        ("x" * 200_001, "200001 characters"),
        ("Here it is.", "not one JSON object"),
        ("{} {}", "Extra data"),
        ('{"Understand": "u"', "line 1 column 19"),
        ('{"a": "\n"}', "'Understand', 'Analyze', 'Functions'"),
        ("[]", "not an object"),
        ('{"Understand": "u", "Analyze": "a", "functions": "f"}', "'Functions'"),
        (json.dumps(GOOD | {"Functions": ""}), "Functions = ''"),
        (json.dumps(GOOD | {"Functions": ["def f(): ..."]}), "Functions = "),
        (json.dumps(GOOD | {"Analyze": "\ud800"}), "surrogate"),
        # Texts that took the parser quadratic time, or too much of the stack.
        ("```" + "\t" * 190_000, "not one JSON object"),
        ("<think>" * 28_000, "not one JSON object"),
        ('{ "' * 60_000, "not one JSON object"),
        ("[" * 100_000, "not one JSON object"),
    ],
)
def test_malformed_reply(text, words):
    with pytest.raises(MalformedReplyError, match=words):
        parse_reply(text)


@pytest.mark.parametrize(
    ("text", "understand"),
    [
        (f"```json\n{json.dumps(WITH_CODE)}\n```", "u"),
        (f"Sure! {{a: b}} Here it is:\n{json.dumps(WITH_CODE)}\nI hope {{that}} helps.", "u"),
        (json.dumps(GOOD | {"Functions": f"```python\n{CODE}\n```"}), "u"),
        (f"The cart moves.\n```python\n{CODE}\n```\nThat is all.", "The cart moves.\n"),
        (f"First:\n```sh\npip install numpy\n```\n```\n{CODE}\n```", "First:\n```sh\npip install numpy\n```\n"),
        (json.dumps(WITH_CODE).replace("\\n", "\n"), "u"),
        (f"<think>As {json.dumps(GOOD)}?</think>\n{json.dumps(WITH_CODE)}", "u"),
        (f"```\n{GOOD['Functions']}\n```\nNo.</thinking>\n```\n{CODE}\n```", "\n"),
        (json.dumps(WITH_CODE | {"Understand": "</think>"}), "</think>"),
        (f"Here it is: {json.dumps(WITH_CODE | {'Understand': '</think>'})}", "</think>"),
        (f"A draft: {json.dumps(GOOD)}, or better: {json.dumps(WITH_CODE)}", "u"),
        (f'First {{"Functions": "draft"}}, then {json.dumps(WITH_CODE)}, {{"Functions": "x"}}', "u"),
        ("{}" * 150 + json.dumps(WITH_CODE), "u"),
        (f"[{json.dumps(WITH_CODE)}]", "u"),
        (f"{json.dumps(WITH_CODE)}</think>", "u"),
        (f"It is\n```python title=phi.py\n{CODE}", "It is\n"),
        (f"1. It is\n   ```\n{textwrap.indent(CODE, '   ')}\n   ```", "1. It is\n   "),
    ],
)
def test_reply_among_other_words(text, understand):
    reply = parse_reply(text)
    assert (reply.understand, reply.functions.strip()) == (understand, CODE)


def test_fence_in_a_docstring():
    source = 'def evaluation_func(observation, action):\n    """Scores.\n    ```\n    x = 1\n    ```\n    """\n    return [action]'
    for code in (source, f"""'''Scores.\n```\nx\n```\n'''\n{CODE}"""):
        assert parse_reply(json.dumps(GOOD | {"Functions": code})).functions == code


def test_words_around_a_fence():
    text = f"This is it:\n```python\n{CODE}\n```\nThe def above returns one factor."
    assert parse_reply(json.dumps(GOOD | {"Functions": text})).functions.strip() == CODE


def test_functions_of_several_fences():
    helper = "def double(x):\n    return 2 * x"
    text = f"A draft:\n```\n{CODE}\n```\nBetter:\n```\n{helper}\n```\n```\n{CODE.replace('[action]', '[double(action)]')}\n```"
    names = {}
    exec(parse_reply(text).functions, names)
    assert names["evaluation_func"](0, 3) == [6]


def test_fence_with_the_function_is_chosen():
    functions = "First\n```python\nimport numpy as np\n```\nand then\n```python\ndef evaluation_func(o, a):\n    return [a]\n```"
    assert parse_reply(json.dumps(GOOD | {"Functions": functions})).functions.startswith("def evaluation_func")


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from([*GOOD, "More"]) | st.text(), inner),
    max_leaves=8,
)


@settings(deadline=None, max_examples=50)
@given(st.text() | st.builds(json.dumps, JSON))
def test_every_text_is_read_or_refused(text):
    with contextlib.suppress(MalformedReplyError):
        assert parse_reply(text).functions


@settings(deadline=None, max_examples=50)
@given(st.fixed_dictionaries({"Understand": st.text(), "Analyze": st.text(), "Functions": st.text(min_size=1)}))
def test_valid_reply_is_read_unchanged(values):
    assert parse_reply(json.dumps(values)) == Reply(**values)
