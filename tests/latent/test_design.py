"""The loop of candidates, combination and correction."""

import pytest

from helpers.scripted_model import ScriptedModel, to_reply
from helpers.toy_envs import PHI, phi_source, toy_spec
from lare_rl.envs.load import read_task
from lare_rl.errors import LareError
from lare_rl.latent.design import DesignError, design
from lare_rl.latent.verify import Check, verify
from lare_rl.llm.prompts import candidate, combine, correct
from lare_rl.llm.recording import read_recording


def failing_reply(name: str) -> str:
    return to_reply(phi_source(f"return [{name}]"))


def error_text(name: str) -> str:
    return f"E-RUN line 2: {name} is not defined, or not available"


GOOD = to_reply(PHI)
OTHER = to_reply(PHI.replace("f_effort", "f_exertion"))
MALFORMED = "Here is the function."
NOT_JSON = "the reply is not one JSON object, and has no fenced function"
ATTEMPTS, MAX_QUOTE = 5, 20_000


def scripted(*replies, **options):
    return ScriptedModel(replies=replies, **options)


def test_draws_and_kinds():
    task = read_task("Reacher-v4")
    functions = [design(task, draw=draw) for draw in (0, 1)]
    assert functions[0].digest != functions[1].digest
    reward = design(task, "reward", candidates=1)
    assert (reward.kind, reward.size) == ("reward", 1)
    with pytest.raises(LareError, match=r"'Chase'.*model=.*--model NAME.*--function phi\.py.*bayes") as error:
        design(toy_spec())
    assert "\n" not in str(error.value)
    for candidates, words in ((3, "1 or 5 candidates"), (0, "= 0"), (101, "= 101")):
        with pytest.raises(LareError, match=words):
            design(task, candidates=candidates)
    with pytest.raises(LareError, match="has teams"):
        design("CompetitivePP-6")
    model = scripted(GOOD)
    with pytest.raises(LareError, match="nothing/Here-v0"):  # the environment is checked first
        design(toy_spec(environment="nothing/Here-v0"), model=model, candidates=1)
    assert model.replies == [GOOD]


def test_error_goes_back(chase):
    bad = failing_reply("no_idea")
    model = scripted(GOOD, OTHER, bad, GOOD)
    function = design(chase, model=model, candidates=2)
    first = candidate(chase)
    second = combine(chase, [GOOD, OTHER])
    third = correct(second, bad, error_text("no_idea"))
    assert (model.requests, model.numbers) == ([first, first, second, third], [0, 1, 0, 0])
    assert function.exchanges == (
        {"stage": "candidate", "messages": first, "replies": [GOOD, OTHER]},
        {"stage": "combine", "messages": second, "replies": [bad]},
        {"stage": "correct", "messages": third, "replies": [GOOD]},
    )
    assert (function.source, function.model) == (PHI.strip("\n"), "scripted")


@pytest.mark.parametrize(
    ("bad", "quote", "errors"),
    [
        (MALFORMED, MALFORMED, NOT_JSON),
        ("x" * (MAX_QUOTE + 5), "x" * MAX_QUOTE, NOT_JSON),
        ("", "(an empty reply)", "the reply is empty"),
    ],
    ids=["malformed", "long", "empty"],
)
def test_correction_request(chase, bad, quote, errors):
    model = scripted(bad, GOOD)
    function = design(chase, model=model, candidates=1)
    assert model.requests == [candidate(chase), correct(candidate(chase), quote, errors)]
    assert [exchange["stage"] for exchange in function.exchanges] == ["candidate", "correct"]


def test_requests_of_surrogates_and_of_a_reward(chase, tmp_path):
    model = scripted(GOOD.replace('""', '"\\ud800"', 1), "\ud800", GOOD)
    design(chase, model=model, candidates=1).save(tmp_path / "phi.py")
    assert "surrogate" in model.requests[1][-1]["content"]
    model = scripted(GOOD, to_reply(phi_source("return [action]")))
    function = design(chase, "reward", model=model, candidates=1)
    error = verify(PHI, chase, "reward").errors
    request = candidate(chase, "reward")
    assert model.requests == [request, correct(request, GOOD, error)]
    assert (function.kind, function.size) == ("reward", 1)


def test_passing_candidates_are_combined(chase):
    candidates = [GOOD, failing_reply("no_idea"), MALFORMED, OTHER]
    model, messages = scripted(*candidates, GOOD), []
    function = design(chase, model=model, candidates=4, on_message=messages.append)
    assert model.requests[-1] == combine(chase, [GOOD, OTHER])
    assert function.exchanges[0]["replies"] == candidates
    assert messages == [
        *("candidate 1: passes", f"candidate 2: {error_text('no_idea')}", f"candidate 3: {NOT_JSON}"),
        *("candidate 4: passes", "attempt 1: passes"),
    ]
    # If none passes, all are combined.
    two_errors = to_reply("import os\n" + phi_source("return [action, np.two(3)]"))
    model, messages = scripted(MALFORMED, two_errors, "x" * (MAX_QUOTE + 5), GOOD), []
    design(chase, model=model, candidates=3, on_message=messages.append)
    assert model.requests[-1] == combine(chase, [MALFORMED, two_errors, "x" * MAX_QUOTE])
    assert messages[1].endswith("(and 1 more)")


def test_attempts_end(chase):
    bad = [failing_reply(f"attempt_{number}") for number in range(1, ATTEMPTS + 1)]
    assert len(design(chase, model=scripted(*bad[1:], GOOD), candidates=1).exchanges) == ATTEMPTS
    model, messages = scripted(*bad, GOOD), []
    with pytest.raises(DesignError, match=r"Chase: .*attempt_5 is not defined") as error:
        design(chase, model=model, candidates=1, on_message=messages.append)
    assert messages == [f"attempt {number}: {error_text(f'attempt_{number}')}" for number in range(1, 6)]
    assert model.replies == [GOOD]
    assert [message["content"] for message in model.requests[-1] if message["role"] == "assistant"] == bad[:-1]
    assert [exchange.replies for exchange in error.value.recorder.exchanges] == [[text] for text in bad]
    assert error.value.recorder.model is model


def test_record(chase, tmp_path):
    path, existed = tmp_path / "record.json", []

    class CheckingModel(ScriptedModel):
        def reply(self, messages, number):
            existed.append(path.exists())
            return super().reply(messages, number)

    function = design(chase, model=CheckingModel(replies=[MALFORMED, GOOD]), candidates=1, record=str(path))
    assert existed == [False, True]
    content = path.read_text(encoding="utf-8")
    recording = read_recording(content, "record.json")
    assert tuple(exchange.model_dump() for exchange in recording.exchanges) == function.exchanges
    with pytest.raises(LareError, match="not overwritten"):
        design(chase, model=CheckingModel(PHI), candidates=1, record=path)
    assert len(existed) == 2  # the model was not asked
    assert path.read_text(encoding="utf-8") == content


def test_without_pre_verification(chase):
    source = phi_source("return [action * np.nan, action]")
    assert not verify(source, chase).passed
    model = scripted(failing_reply("a"), GOOD, to_reply(source))
    function = design(chase, model=model, candidates=2, pre_verification=False)
    assert (function.source, function.size) == (source, 2)
    assert function.checks == (Check("read", True),)
    assert function.names == ["factor_1", "action"]
    assert model.requests[-1] == combine(chase, [failing_reply("a"), GOOD])
    for text in (MALFORMED, to_reply("import os\nos.listdir('/')"), to_reply(phi_source("return action"))):
        with pytest.raises(DesignError, match="cannot be read"):
            design(chase, model=scripted(text), candidates=1, pre_verification=False)


@pytest.mark.parametrize(
    ("error", "status"), [(LareError("no model"), 2), (RuntimeError("server down"), 2), (KeyboardInterrupt(), 130)]
)
def test_replies_survive_an_error(chase, error, status):
    with pytest.raises(DesignError) as raised:
        design(chase, model=scripted(GOOD, failing_reply("a"), error=error), candidates=3)
    assert [exchange.replies for exchange in raised.value.recorder.exchanges] == [[GOOD, failing_reply("a")]]
    assert raised.value.status == status
    with pytest.raises(LareError if status == 2 else KeyboardInterrupt) as raised:
        design(chase, model=scripted(error=error), candidates=3)
    assert not isinstance(raised.value, DesignError)


def test_reply_that_is_no_text(chase):
    """The replies before it were paid for."""
    with pytest.raises(DesignError, match="must return a text") as raised:
        design(chase, model=scripted(GOOD, None), candidates=2)
    assert [exchange.replies for exchange in raised.value.recorder.exchanges] == [[GOOD]]
