"""What counts as a language model: an object with a name and replies, or a function."""

import pytest

import lare_rl
from helpers.scripted_model import ScriptedModel, to_reply
from helpers.toy_envs import PHI, toy_spec
from lare_rl.errors import LareError
from lare_rl.llm.live import LiveModel
from lare_rl.llm.model import as_model, ask

REPLY = to_reply(PHI)


def test_function_is_a_model():
    requests = []

    def my_model(messages):
        requests.append([message["role"] for message in messages])
        return REPLY if len(requests) > 1 else "no"

    phi = lare_rl.design(toy_spec(), model=my_model, candidates=1)
    assert (phi.source, phi.model) == (PHI.strip("\n"), "my_model")
    assert requests == [["system", "user"], ["system", "user", "assistant", "user"]]


def test_key_and_half_of_surrogate_pair_are_removed(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", "sk-secret-key")
    assert ask(as_model(lambda messages: "\ud83d"), []) == "?"
    assert ask(as_model(lambda messages: "It is sk-secret-key."), []) == "It is [key]."
    with pytest.raises(LareError, match=r"KeyError: '\[key\]'"):
        ask(as_model(lambda messages: {}["sk-secret-key"]), [])


def test_objects_with_a_name_are_used_as_they_are(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", "none")
    for model in (ScriptedModel(PHI), LiveModel("m", "http://127.0.0.1:1/v1")):
        assert as_model(model) is model
    model = ScriptedModel(PHI)
    model.name = None
    with pytest.raises(LareError, match=r"name \(a text\)"):
        as_model(model)
