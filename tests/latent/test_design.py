"""The loop of candidates, combination and correction: what is asked, what is kept, and when it gives up."""

import json
import re

import gymnasium
import pytest

from helpers.tiers import long
from helpers.toys import PHI, Chase, phi, toy_spec
from lare_rl.envs.load import read_task, shipped_tasks
from lare_rl.errors import LareError
from lare_rl.latent import design as module
from lare_rl.latent.design import ATTEMPTS, LONGEST_QUOTE, DesignBroken, DesignFailed, DesignStopped, design
from lare_rl.latent.verify import Check, Verdict, verify
from lare_rl.llm.prompts import candidate, combine, correct
from lare_rl.llm.recording import read_recording
from lare_rl.phi.read import read


def reply(source: str) -> str:
    return json.dumps({"Understand": "u", "Analyze": "a", "Functions": source})


def failing(name: str) -> str:
    return reply(phi(f"return [{name}]"))


def error_of(name: str) -> str:
    return f"E-RUN line 2: {name} is not defined, or not available"


GOOD = reply(PHI)
OTHER = reply(PHI.replace("f_effort", "f_exertion"))
MALFORMED = "Here is the function."
NOT_JSON = "the reply is not one JSON object: Expecting value: line 1 column 1 (char 0)"


class Scripted:
    """A model that says its lines, and remembers what it was asked."""

    name = "scripted"

    def __init__(self, *lines: str):
        self.lines = list(lines)
        self.asked = []

    def reply(self, messages, sample):
        self.asked.append((list(messages), sample))
        return self.lines.pop(0)


@pytest.fixture
def trusting(monkeypatch):
    """Every source passes: for what is about the requests alone."""
    monkeypatch.setattr(module, "verify", lambda *_: Verdict((Check("read", True),), read(PHI, 2, 1)))


ONE_OF_A_KIND = ("CN-6", "CompetitivePP-6", "HalfCheetah-v4", "Reacher-v4", "SMAX-2s3z", "TriangleArea", "Walker2d-v4")


@pytest.mark.parametrize(
    "name",
    [name if name in ONE_OF_A_KIND else long(name) for name in shipped_tasks() if not name.startswith("SMAC-")],
)
def test_every_shipped_task_has_its_function(name):
    spec = read_task(name)
    if spec.teams:
        with pytest.raises(LareError, match="CompetitivePP-6 has a latent function for each of its teams: name one of"):
            design(spec)
        return
    function = design(spec)
    assert function.task == name
    assert re.fullmatch(r"Claude \(Anthropic\), recorded 2026-11-2[03], draw 0", function.model)
    assert [exchange["stage"] for exchange in function.exchanges] == ["candidate", "combine"]
    assert function.size == len(set(function.names)) > 1
    assert function.checks
    assert all(check.passed for check in function.checks)


def test_draws_are_different_samples(trusting):
    functions = [design(read_task("Reacher-v4"), draw=draw) for draw in (0, 1)]
    assert functions[0].digest != functions[1].digest


def test_a_reward_is_one_factor():
    function = design(read_task("Reacher-v4"), "reward", candidates=1)
    assert (function.kind, function.size) == ("reward", 1)


def test_a_failure_goes_back_with_its_error(chase):
    bad = failing("no_idea")
    model = Scripted(GOOD, OTHER, bad, GOOD)
    function = design(chase, model=model, candidates=2)
    first = candidate(chase)
    second = combine(chase, [GOOD, OTHER])
    third = correct(second, bad, error_of("no_idea"))
    assert model.asked == [(first, 0), (first, 1), (second, 0), (third, 0)]
    assert function.exchanges == (
        {"stage": "candidate", "messages": first, "replies": [GOOD, OTHER]},
        {"stage": "combine", "messages": second, "replies": [bad]},
        {"stage": "correct", "messages": third, "replies": [GOOD]},
    )
    assert (function.source, function.model) == (PHI.strip("\n"), "scripted")


def test_every_error_goes_back(chase):
    source = "import os\n" + phi("return [action, np.two(3)]")
    bad, errors = reply(source), verify(source, chase).errors
    assert [line.split(":")[0] for line in errors.splitlines()] == ["E-IMPORT line 1", "E-NUMPY line 3"]
    model = Scripted(bad, GOOD)
    design(chase, model=model, candidates=1)
    assert model.asked[1] == (correct(candidate(chase), bad, errors), 0)


def test_candidates_that_do_not_pass_are_left_out(chase):
    model = Scripted(GOOD, failing("no_idea"), MALFORMED, OTHER, GOOD)
    said = []
    function = design(chase, model=model, candidates=4, said=said.append)
    assert model.asked[-1] == (combine(chase, [GOOD, OTHER]), 0)
    # What was left out was asked for all the same, and is kept.
    assert function.exchanges[0]["replies"] == [GOOD, failing("no_idea"), MALFORMED, OTHER]
    assert said == [
        "candidate 1: passes",
        f"candidate 2: {error_of('no_idea')}",
        f"candidate 3: {NOT_JSON}",
        "candidate 4: passes",
        "attempt 1: passes",
    ]


def test_where_no_candidate_passes_all_are_shown(chase):
    long = "x" * (LONGEST_QUOTE + 5)
    model = Scripted(MALFORMED, failing("no_idea"), long, GOOD)
    design(chase, model=model, candidates=3)
    assert model.asked[-1] == (combine(chase, [MALFORMED, failing("no_idea"), "x" * LONGEST_QUOTE]), 0)


def test_one_candidate_is_not_combined(chase, trusting):
    model = Scripted(GOOD)
    function = design(chase, model=model, candidates=1)
    assert model.asked == [(candidate(chase), 0)]
    assert [exchange["stage"] for exchange in function.exchanges] == ["candidate"]


def test_a_malformed_reply_can_be_corrected(chase, trusting):
    model = Scripted(MALFORMED, GOOD)
    design(chase, model=model, candidates=1)
    assert model.asked[1] == (correct(candidate(chase), MALFORMED, NOT_JSON), 0)


def test_a_reply_without_end_is_shown_cut_off(chase, trusting):
    long = "x" * (LONGEST_QUOTE + 5)
    model = Scripted(long, GOOD)
    design(chase, model=model, candidates=1)
    assert model.asked[1] == (correct(candidate(chase), "x" * LONGEST_QUOTE, NOT_JSON), 0)


def test_the_kind_is_what_is_asked_and_checked(chase):
    one = reply(phi("return [action]"))
    model = Scripted(GOOD, one)
    function = design(chase, "reward", model=model, candidates=1)
    error = verify(PHI, chase, "reward").errors
    assert [messages for messages, _ in model.asked] == [
        candidate(chase, "reward"),
        correct(candidate(chase, "reward"), GOOD, error),
    ]
    assert (function.kind, function.size) == ("reward", 1)


def test_it_gives_up_with_the_last_errors(chase):
    bad = [failing(f"attempt_{number}") for number in range(1, ATTEMPTS + 1)]
    model = Scripted(*bad, GOOD)
    said = []
    with pytest.raises(DesignFailed) as error:
        design(chase, model=model, candidates=1, said=said.append)
    assert str(error.value) == (
        f"task 'Chase': none of 5 attempts passed; the last one failed: {error_of('attempt_5')}"
    )
    assert said == [f"attempt {number}: {error_of(f'attempt_{number}')}" for number in range(1, 6)]
    assert model.lines == [GOOD]
    # Each request carries all the failures before it.
    last, _ = model.asked[-1]
    assert [message["content"] for message in last if message["role"] == "assistant"] == bad[:-1]
    # And nothing that was said is lost.
    assert [exchange.replies for exchange in error.value.recorder.exchanges] == [[one] for one in bad]
    assert error.value.model == "scripted"


def test_the_last_attempt_may_be_the_good_one(chase, trusting):
    model = Scripted(*[MALFORMED] * (ATTEMPTS - 1), GOOD)
    assert len(design(chase, model=model, candidates=1).exchanges) == ATTEMPTS


def test_a_record_is_kept_from_the_first_reply_on(chase, trusting, tmp_path):
    path = tmp_path / "record.json"
    kept = []

    class Looks(Scripted):
        def reply(self, messages, sample):
            kept.append(path.exists())
            return super().reply(messages, sample)

    function = design(chase, model=Looks(MALFORMED, GOOD), candidates=1, record=path)
    assert kept == [False, True]
    recording = read_recording(path.read_text(encoding="utf-8"), "record.json")
    assert tuple(exchange.model_dump() for exchange in recording.exchanges) == function.exchanges
    before = path.read_text()
    with pytest.raises(LareError, match="exists, and is not overwritten"):
        design(chase, model=Scripted(GOOD), candidates=1, record=path)
    assert path.read_text() == before


# --- without verification, as an ablation ----------------------------------------------------------------------------


def test_without_verification_what_can_be_read_is_kept(chase):
    source = phi("return [action * np.nan, action]")
    assert not verify(source, chase).passed
    model = Scripted(reply(source), GOOD)
    function = design(chase, model=model, candidates=1, pre_verification=False)
    assert (function.source, function.size) == (source, 2)
    assert function.checks == (Check("read", True),)
    assert function.names == ["factor_1", "action"]
    assert model.lines == [GOOD]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (MALFORMED, re.escape(NOT_JSON)),
        (reply(phi("raise ValueError('no idea')")), "E-RUN line 2: .*ValueError: no idea"),
        (reply("import os\nos.listdir('/')"), "E-IMPORT line 1: import os"),
        (reply(phi("return action")), "E-FORM line 2: evaluation_func must return a list of arrays"),
        (reply(phi("return [action - action.mean()]")), "E-ROWS line 2: "),
    ],
)
def test_without_verification_what_cannot_be_read_is_no_function(chase, line, message):
    with pytest.raises(DesignFailed, match=f"^task 'Chase': the reply cannot be read: {message}"):
        design(chase, model=Scripted(line), candidates=1, pre_verification=False)


def test_a_task_without_recordings_is_refused():
    with pytest.raises(
        LareError, match=r"\Ano recorded reply fits this request for task 'Chase' \(reply 1\): [^\n]+\Z"
    ):
        design(toy_spec())


def test_without_verification_nobody_looks_at_candidates(chase, trusting):
    model = Scripted(failing("a"), GOOD, GOOD)
    design(chase, model=model, candidates=2, pre_verification=False)
    assert model.asked[-1][0] == combine(chase, [failing("a"), GOOD], "factors")


class Leaves(Scripted):
    """A model that is gone after its last line."""

    def reply(self, messages, sample):
        if not self.lines:
            raise LareError("nobody there")
        return super().reply(messages, sample)


def test_what_was_said_is_kept_when_the_model_leaves(chase):
    with pytest.raises(DesignBroken, match=r"^nobody there$") as error:
        design(chase, model=Leaves(failing("a"), failing("b")), candidates=1)
    assert [exchange.stage for exchange in error.value.recorder.exchanges] == ["candidate", "correct"]
    with pytest.raises(LareError) as error:
        design(chase, model=Leaves(), candidates=1)
    assert not isinstance(error.value, DesignFailed)


def test_what_was_said_is_kept_when_somebody_stops_it(chase):
    class Stops(Scripted):
        def reply(self, messages, sample):
            if not self.lines:
                raise KeyboardInterrupt
            return super().reply(messages, sample)

    with pytest.raises(DesignStopped, match=r"^stopped$") as error:
        design(chase, model=Stops(GOOD), candidates=3)
    assert [exchange.replies for exchange in error.value.recorder.exchanges] == [[GOOD]]
    assert error.value.status == 130
    with pytest.raises(KeyboardInterrupt):
        design(chase, model=Stops(), candidates=3)


class Fails(Chase):
    def reset(self, *, seed=None, options=None):
        raise RuntimeError("no track\nin sight")


gymnasium.register("misfits/Fails-v0", entry_point=Fails, max_episode_steps=20)


def test_an_environment_that_does_not_run_costs_nothing():
    model = Scripted(GOOD)
    with pytest.raises(LareError) as error:
        design(toy_spec(environment="misfits/Fails-v0"), model=model, candidates=1)
    assert str(error.value) == "environment 'misfits/Fails-v0' failed in reset: no track"
    assert model.lines == [GOOD]


def test_an_empty_reply_is_not_sent_back_empty(chase, trusting):
    model = Scripted("", GOOD)
    design(chase, model=model, candidates=1)
    assert model.asked[1] == (correct(candidate(chase), "(an empty reply)", "the reply is empty"), 0)


def test_half_a_character_goes_back_as_an_error(chase, tmp_path):
    broken = GOOD.replace('"u"', '"\\ud800"')
    model = Scripted(broken, "\ud800", GOOD)
    function = design(chase, model=model, candidates=1, said=[].append)
    assert "which is half a character (a surrogate)" in model.asked[1][0][-1]["content"]
    function.save(tmp_path / "phi.py")


@pytest.mark.parametrize("n", [0, -1, 101])
def test_too_few_candidates_or_too_many(chase, n):
    with pytest.raises(LareError, match=f"candidates = {n}: from 1 to 100"):
        design(chase, candidates=n)
