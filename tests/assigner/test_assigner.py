"""`CreditAssigner`: what it was shown is what it learns from, and what it says is by the newest decoder."""

import threading

import gymnasium
import jax
import numpy as np
import pytest

from helpers.shown import SMALL, TASK, Shown, assigner, episode, episodes, show
from helpers.tiers import long
from helpers.toys import pick_spec
from lare_rl.assigner import assigner as assigners
from lare_rl.assigner import decoder_learner as learner
from lare_rl.assigner import payment
from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import METHODS
from lare_rl.errors import LareError

ALONE = [name for name, row in METHODS.items() if row.has_proxy and not row.whole_episodes and not row.for_many_only]
TOGETHER = [name for name, row in METHODS.items() if row.has_proxy and not row.whole_episodes and not row.for_one_only]
ALL_KINDS = {"rd", "rrd", "bayes", "lare-rd", "lare-rd-shared", "lare-signs", "ircr", "llm-reward"}
"""Methods of all kinds of features, fits and payments."""


@pytest.fixture
def function(request, phi, reward):
    """What a method needs of a language model."""
    row = METHODS[request.getfixturevalue("method")]
    return (reward if row.kind == "reward" else phi) if row.latent else None


@pytest.mark.parametrize("method", ALONE)
def test_every_method_pays_every_step(method, function):
    """By numbers of steps or by the steps themselves: the same."""
    credit, shown = assigner(method, function), episodes([10] * 12)
    numbers = [show(credit, one, lane) for lane, one in enumerate(shown)]
    credit.fit_owed()
    r_hat = credit.rewards_at(numbers)
    assert r_hat.shape == (12, 10)
    assert r_hat.dtype == np.float32
    assert r_hat.flags.writeable
    assert np.isfinite(r_hat).all()
    assert r_hat.std() > 0
    if method == "ircr":
        means = np.array([one.reward.mean() for one in shown])
        np.testing.assert_allclose(r_hat[:, 0], (means - means.min()) / np.ptp(means), rtol=1e-5)
        with pytest.raises(LareError) as refused:
            credit.rewards(*shown[0][:3])
        assert (
            str(refused.value)
            == "ircr pays by the return of a step's episode: call rewards_at, with the numbers of steps"
        )
    else:
        for one, paid in zip(shown, r_hat, strict=True):
            np.testing.assert_allclose(credit.rewards(*one[:3]), paid, rtol=1e-5, atol=1e-6)  # in other batches
    metrics = credit.metrics()
    assert metrics["credit/episodes"] == 12
    assert metrics["credit/dropped"] == 0
    assert (metrics["credit/fits"] > 0) == np.isfinite(metrics["credit/loss"]) == METHODS[method].descends


@pytest.mark.parametrize("method", ["lare-linear", "rd", "ircr"])
def test_nothing_is_paid_before_anything_is_known(method, function):
    """But that ircr says that half the range is as good as anything."""
    credit, one = assigner(method, function), episodes([5])[0]
    numbers = show(credit, one, end=False)
    assert credit.rewards_at(numbers).tolist() == [0.5 if method == "ircr" else 0.0] * 5
    assert credit.rewards_at([[-1, -1]]).tolist() == [[0.0, 0.0]]
    assert credit.rewards_at([]).shape == (0,)
    assert np.isnan(credit.metrics()["credit/return_r2"])


def test_factors_that_say_the_reward_become_the_reward(phi):
    credit, shown = assigner("lare-linear", phi), episodes([10] * 40)
    for one in shown:
        credit.add_episode(*one)
        credit.fit_owed()
    new = episodes([50], seed=1)[0]
    np.testing.assert_allclose(credit.rewards(*new[:3]), new.reward, atol=0.01)
    assert credit.metrics()["credit/return_r2"] > 0.9
    assert credit.explanation()[0].startswith("The factors explain")


@pytest.mark.parametrize("method", ["lare-bayes", "rd", "lare-rrdu", "llm-reward"])
def test_a_step_is_the_same_step_however_it_is_shown(method, function):
    """Alone, with others of other lanes, or as a whole episode; rewards as they come or as a score at the end."""
    shown = episodes([8, 3, 6, 8, 5] * 3)
    single, whole, scored = (assigner(method, function) for _ in range(3))
    for one in shown:
        show(single, one)
        single.fit_owed()
        whole.add_episode(*one)
        whole.fit_owed()
        scored.add_episode(*one[:3], one.reward.sum())
        scored.fit_owed()
    every = np.arange(single.store.steps)
    np.testing.assert_array_equal(whole.store.features, single.store.features)
    np.testing.assert_array_equal(whole.rewards_at(every), single.rewards_at(every))
    np.testing.assert_allclose(scored.rewards_at(every), single.rewards_at(every), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("method", ["lare-bayes", "lare-linear"])
def test_the_third_return_is_the_first_that_is_predicted(method, phi):
    """From one episode a decoder in closed form learns the mean reward only. R^2 needs eight predicted returns."""
    credit = assigner(method, phi)
    known = []
    for one in episodes([10] * 12):
        credit.add_episode(*one)
        known.append(bool(np.isfinite(credit.metrics()["credit/return_r2"])))
    assert known == [False] * 9 + [True] * 3


@pytest.mark.parametrize("asked", ["after each episode", "at the end"])
def test_returns_are_predicted_by_fits_to_those_before_whenever_it_is_asked(asked, phi):
    credit = assigner("lare-linear", phi)
    for one in episodes([10] * 40):
        credit.add_episode(*one)
        if asked == "after each episode":
            credit.metrics()
    assert 0.9 < credit.metrics()["credit/return_r2"] <= 1
    assert float(credit.learner.state.closed.fitted) > 38


def test_lanes_come_in_between_each_other():
    credit, shown = assigner(), episodes([4, 2, 3, 5])
    left = {lane: list(zip(*one, strict=True)) for lane, one in zip("abcd", shown, strict=True)}
    while left:
        rows = [steps.pop(0) for steps in left.values()]
        ended = [not steps for steps in left.values()]
        credit.add(*map(np.array, zip(*rows, strict=True)), ended, np.zeros(len(rows)), lanes=list(left))
        left = {lane: steps for lane, steps in left.items() if steps}
    found = sorted((len(one.steps), one.score) for one in credit.store.episodes.values())
    assert found == sorted((len(one.reward), sum(one.reward.tolist())) for one in shown)
    assert credit.store.dropped == 0


def test_a_row_that_is_no_step_has_no_number():
    credit, (one,) = assigner(), episodes([3])
    rows = [np.repeat(part[:1], 3, axis=0) for part in one]
    rows[0][1] = np.nan  # nobody looks at it
    found = credit.add(*rows, [False, True, True], [False] * 3, valid=[True, False, True])
    assert found.tolist() == [0, -1, 1]
    assert credit.store.ended == 1
    assert list(credit.store.running) == [0]
    assert credit.rewards_at(found).shape == (3,)
    nothing = credit.add(*rows, [True] * 3, [False] * 3, valid=[False] * 3)
    assert nothing.tolist() == [-1] * 3
    assert len(credit.waiting) == 0


def test_an_environment_may_write_its_next_step_into_the_same_memory():
    credit, (one,) = assigner(), episodes([6])
    before, after = np.zeros((1, 2), np.float32), np.zeros((1, 2), np.float32)
    numbers = []
    for place in range(6):
        before[:], after[:] = one.before[place], one.after[place]
        numbers += credit.add(before, one.action[[place]], after, one.reward[[place]], [place == 5], [False]).tolist()
    assert credit.store.dropped == 0
    credit.look()
    np.testing.assert_array_equal(credit.store.features[numbers], np.hstack([one.after, one.action]))


def test_a_reset_in_between_drops_the_episode():
    credit, (one, other) = assigner(), episodes([5, 4])
    given_up = show(credit, one, end=False)
    show(credit, other)
    assert credit.metrics()["credit/dropped"] == 1
    (kept,) = credit.store.episodes.values()
    assert kept.score == sum(other.reward.tolist())
    assert credit.rewards_at(given_up).shape == (5,)


def test_an_episode_can_be_given_up():
    credit, (one, other) = assigner(), episodes([5, 4])
    show(credit, one, end=False)
    credit.drop(0)
    credit.drop("another")
    assert credit.metrics()["credit/dropped"] == 1
    show(credit, other)
    assert [len(kept.steps) for kept in credit.store.episodes.values()] == [4]


def test_scores_may_come_late():
    """Every episode in a lane of its own; while they wait, others end."""
    credit, shown = assigner(), episodes([3, 5, 4])
    for lane, one in enumerate(shown):
        show(credit, one, ("game", lane), end=False)
    credit.end(("game", 1), 7.0)
    credit.end(("game", 0))
    assert [(len(one.steps), one.score) for one in credit.store.episodes.values()] == [
        (5, 7.0),
        (3, sum(shown[0].reward.tolist())),
    ]
    assert list(credit.store.running) == [("game", 2)]


@pytest.mark.parametrize(
    ("lane", "score", "message"),
    [
        ("x", None, "no episode is running in lane 'x': it has ended, or is older than 1000 steps (capacity)"),
        (0, float("nan"), "score = nan of lane 0 is not finite"),
        (0, float("inf"), "score = inf of lane 0 is not finite"),
    ],
)
def test_what_cannot_end_is_refused(lane, score, message):
    credit, (one,) = assigner(), episodes([3])
    show(credit, one, end=False)
    with pytest.raises(LareError) as refused:
        credit.end(lane, score)
    assert str(refused.value) == message
    credit.end(0)


def test_the_oldest_steps_go():
    credit = assigner(capacity=20)
    numbers = [show(credit, one) for one in episodes([6] * 5)]
    assert [one.steps.tolist() for one in credit.store.episodes.values()] == numbers[2:]
    credit.fit()
    assert np.isfinite(credit.rewards_at(numbers[2:])).all()
    with pytest.raises(LareError) as refused:
        credit.rewards_at(numbers[1])
    assert str(refused.value) == "step 6 is not stored, only 10 to 29 is (capacity = 20)"
    with pytest.raises(LareError, match="step 30 is not stored"):
        credit.rewards_at([30])


def test_an_episode_that_is_longer_than_all_that_is_kept_is_refused():
    credit = assigner(capacity=20)
    with pytest.raises(LareError) as refused:
        show(credit, episodes([21])[0])
    assert str(refused.value) == (
        "an episode of 21 steps has ended, and its first ones are not stored any more: capacity = 20 must be larger"
    )


def test_many_steps_at_once_are_looked_at_some_at_a_time(monkeypatch, phi):
    (long,) = episodes([700])
    alone = assigner("lare-linear", phi)
    for module in (assigners, learner, payment):
        monkeypatch.setattr(module, "PIECE", 64)
    pieces = assigner("lare-linear", phi)
    for credit in (alone, pieces):
        lanes = np.arange(700) // 10
        numbers = credit.add(*long, np.arange(700) % 10 == 9, np.zeros(700), lanes=lanes.tolist())
        credit.fit()
        assert len(credit.store.episodes) == 70
    np.testing.assert_array_equal(pieces.store.features, alone.store.features)
    np.testing.assert_allclose(pieces.rewards_at(numbers), alone.rewards_at(numbers), atol=1e-3)


ROW = np.zeros((2, 2)), np.zeros((2, 1)), np.zeros((2, 2)), np.zeros(2), np.zeros(2), np.zeros(2)


def instead(place, value):
    return [value if number == place else part for number, part in enumerate(ROW)]


@pytest.mark.parametrize(
    ("rows", "more", "message"),
    [
        (instead(0, np.zeros((2, 3))), {}, "before must be rows of 2 numbers, and has the shape (2, 3)"),
        (
            instead(0, np.zeros(2)),
            {},
            "before must be rows (steps, 2), and its shape is (2,)",
        ),
        (
            instead(1, np.zeros((3, 1))),
            {},
            "action must be rows (steps, 1), as many as before has, and its shape is (3, 1)",
        ),
        (instead(2, np.zeros((2, 1))), {}, "after must be rows of 2 numbers, and has the shape (2, 1)"),
        (
            instead(3, np.zeros((2, 1))),
            {},
            "reward must be one number for each of 2 steps, and its shape is (2, 1)",
        ),
        (instead(4, np.zeros(3)), {}, "terminated must be one flag for each of 2 steps, and has the shape (3,)"),
        (instead(5, False), {}, "truncated must be one flag for each of 2 steps, and has the shape ()"),
        (ROW, {"valid": [True]}, "valid must be one flag for each of 2 steps, and has the shape (1,)"),
        (ROW, {"lanes": [0]}, "lanes has 1 entries, and there are 2 steps"),
        (
            ROW,
            {"alive": np.ones((2, 1))},
            "alive must be (2, agents) of more than one agent, and its shape is (2, 1)",
        ),
        (instead(0, [[0, 0], [0, np.nan]]), {}, "before of row 1 holds nan: a number must be finite"),
        (instead(1, [[np.inf], [0]]), {}, "action of row 0 holds inf: a number must be finite"),
        (instead(2, [[0, 0], [0, 1e300]]), {}, "after of row 1 holds inf: a number must be finite"),
        (
            instead(3, [0, -np.inf]),
            {"valid": [False, True]},
            "reward of row 1 holds -inf: a number must be finite",
        ),
    ],
)
def test_rows_that_do_not_fit_are_refused(rows, more, message):
    credit = assigner()
    with pytest.raises(LareError) as refused:
        credit.add(*rows, **more)
    assert str(refused.value) == message
    assert credit.store.steps == 0
    credit.add(*ROW)


def test_an_episode_without_a_step_is_refused():
    with pytest.raises(LareError, match=r"^the episode has no step$"):
        assigner().add_episode(np.zeros((0, 2)), np.zeros((0, 1)), np.zeros((0, 2)), 1.0)


@pytest.mark.parametrize(
    ("method", "changes", "message"),
    [
        ("dense", {}, "dense assigns no credit: train on what the environment pays"),
        ("episodic", {}, "episodic assigns no credit: train on what the environment pays"),
        (
            "arel",
            {"agents": 2, "max_steps": 5},
            "arel looks at whole episodes at once, not at sampled steps: use it with `lare_rl.train`",
        ),
        ("lare-rd", {}, "lare-rd needs a phi; bayes, rd and rrdu need none"),
        ("diaster", {"agents": 2, "max_steps": 5}, "diaster assigns credit to a single agent, and agents = 2"),
        ("rd", {"agents": 2}, "many agents need max_steps, the steps of the longest episode"),
        (
            "ircr",
            {"scale_rewards": True},
            "scale_rewards divides by the size of returns, and rewards of ircr are not in their unit",
        ),
        (
            "rd-linear",
            {"observation_space": 10_000},
            "rd-linear fits a weight to each of at most 1024 entries, and there are 10001: use rrdu, a network",
        ),
        (
            "rrdu",
            {"settings": CreditSettings(drawn_steps=8, steps=4)},
            "settings.steps = 4 is less than settings.drawn_steps = 8, of one episode",
        ),
        ("rd", {"action_space": None}, "CreditAssigner needs observation_space and action_space, or a task"),
        (
            "rd",
            {"task": TASK, "observation_space": 3},
            "observation_space has rows of 3 numbers, and task 'Chase' has observation_size = 2",
        ),
    ],
)
def test_what_does_not_go_together_is_refused(method, changes, message):
    with pytest.raises(LareError) as refused:
        assigner(method, **changes)
    assert str(refused.value) == message


def test_a_function_that_does_not_belong_is_refused(phi, reward):
    said = {}
    for name, method, function, changes in [
        ("none needed", "rd", phi, {}),
        ("kind", "lare-rd", reward, {}),
        ("task", "lare-rd", phi, {"task": None, "observation_space": 2, "action_space": 1}),
        ("both", "llm-reward", reward, {"judges": "both"}),
        ("alone", "lare-rd-shared", phi, {}),
    ]:
        with pytest.raises(LareError) as refused:
            assigner(method, function, **changes)
        said[name] = str(refused.value)
    assert said == {
        "none needed": "rd needs no phi: leave it out, or take lare-bayes",
        "kind": "lare-rd needs a phi of the kind 'factors', and this one is of the kind 'reward'",
        "task": "a phi needs the task that it was designed for: CreditAssigner(..., phi, task=task)",
        "both": "llm-reward is one reward a step: it judges the observation before or after, not both",
        "alone": "lare-rd-shared assigns credit among agents, and agents = 1",
    }


def test_spaces_may_come_from_gymnasium():
    spaces = gymnasium.spaces
    observation = spaces.Dict(place=spaces.Box(-1, 1, (2,)), mode=spaces.Discrete(3))
    credit = CreditAssigner("rd", observation_space=observation, action_space=spaces.Discrete(4, start=1))
    shown = {"place": np.ones((2, 2)), "mode": np.array([0, 2])}
    credit.add(shown, np.array([1, 4]), shown, [0, 0], [False] * 2, [False] * 2)
    credit.look()
    rows = [[1, 1, 1, 0, 0], [1, 1, 0, 0, 1]]
    np.testing.assert_array_equal(
        credit.store.features[:2], np.hstack([rows, [[1, 0, 0, 0], [0, 0, 0, 1]], np.zeros((2, 5))])
    )


def test_a_task_of_choices_takes_choices():
    credit = CreditAssigner("bayes", task=pick_spec())
    credit.add(np.eye(4)[:2], np.array([3, 0]), np.eye(4)[1:3], [0, 0], [False] * 2, [False] * 2)
    credit.look()
    np.testing.assert_array_equal(credit.store.features[:2, 4:], np.eye(4)[[3, 0]])


@pytest.mark.parametrize("judges", ["before", "after", "both"])
def test_factors_judge_the_observation_that_they_should(judges, phi):
    credit, (one,) = assigner("lare-rd", phi, judges=judges), episodes([4])
    credit.add_episode(*one)
    credit.look()
    np.testing.assert_array_equal(credit.store.features[:4], phi.of_steps(*one[:3], judges))


@pytest.mark.parametrize("judges", ["before", "after", "both"])
def test_so_do_the_raw_entries_of_closed_forms(judges):
    credit, (one,) = assigner("bayes", judges=judges), episodes([4])
    credit.add_episode(*one)
    credit.look()
    before, _, after, *_ = one
    states = {"before": [before], "after": [after], "both": [before, after]}[judges]
    np.testing.assert_array_equal(credit.store.features[:4, :-1], np.concatenate(states, axis=1))
    assert credit.config.entries == credit.store.features.shape[1] == 2 * len(states) + 1


@pytest.mark.parametrize("score", ["sum", "average"])
@pytest.mark.parametrize("given", ["auto", "sum", "average"])
def test_the_form_of_a_score_is_found_out_and_rewards_add_up_to_it(score, given, phi):
    """Where the form is the right one."""
    lengths = np.random.default_rng(0).integers(3, 13, size=80)
    credit = assigner("lare-linear", phi, settings=CreditSettings(score=given), capacity=2000)
    totals, numbers = [], []
    for one in episodes(lengths):
        totals.append(one.reward.sum() if score == "sum" else one.reward.mean())
        numbers.append(credit.add_episode(*one[:3], totals[-1]))
        credit.fit_owed()
    assert credit.form == (score if given == "auto" else given)
    error = np.array([credit.rewards_at(steps).sum() for steps in numbers]) - totals
    assert (np.abs(error).max() < 0.05 * np.std(totals)) == (given in ("auto", score))


def test_the_task_says_the_form_of_its_score():
    credit = CreditAssigner("rd-linear", task=TASK.model_copy(update={"score": "average"}))
    assert credit.config.settings.score == "average"
    assert credit.form == "average"


def test_updates_are_owed_for_steps_and_made_in_chunks():
    credit = assigner("rd", fits_per_step=2.0)
    show(credit, episodes([20])[0], end=False)
    credit.fit_owed()
    assert credit.learner.fits == 0
    assert credit.learner.owed == 40
    credit.end(0)
    credit.fit_owed()
    assert credit.learner.fits == 32
    assert credit.learner.owed == 8
    credit.fit_owed()
    assert credit.learner.fits == 32
    credit.fit(5)
    assert credit.learner.fits == 37
    assert credit.learner.owed == 0


def test_no_more_is_owed_than_can_be_made_up_for():
    credit = assigner("rd", fits_per_step=100.0)
    show(credit, episodes([20])[0])
    assert credit.learner.owed == learner.MOST_OWED


@pytest.mark.parametrize("method", ["rd", "rd-linear", "ircr"])
def test_to_fit_nothing_is_no_fault(method):
    credit = assigner(method)
    credit.fit(3)
    credit.fit_owed()
    assert credit.learner.fits == 0
    assert credit.explanation() == []


@pytest.mark.parametrize("method", ["rd", "rd-linear"])
def test_it_is_the_newest_decoder_that_pays(method):
    credit, shown = assigner(method), episodes([8] * 40)
    for one in shown[:10]:
        credit.add_episode(*one)
    credit.fit(16)
    first = credit.rewards_at(np.arange(10))
    for one in shown[10:]:
        credit.add_episode(*one)
    credit.fit(16)
    assert not np.array_equal(credit.rewards_at(np.arange(10)), first)


def test_chance_comes_from_the_seed():
    def run(seed):
        credit = assigner("rrdu", seed=seed)
        for one in episodes([8] * 5):
            credit.add_episode(*one)
            credit.fit_owed()
        return credit.rewards_at(np.arange(40))

    np.testing.assert_array_equal(run(3), run(3))
    assert not np.array_equal(run(3), run(4))


def test_rewards_may_be_scaled():
    credit, scaled = assigner("rd-linear"), assigner("rd-linear", scale_rewards=True)
    shown = episodes([8] * 12)
    for one in shown:
        credit.add_episode(*one)
        scaled.add_episode(*one)
    size = np.sqrt(np.mean([one.reward.mean() ** 2 for one in shown]))
    np.testing.assert_allclose(scaled.rewards_at(range(8)) * size, credit.rewards_at(range(8)), rtol=1e-4)


def test_optimism_pays_what_little_is_known_of():
    plain, brave = (
        assigner("rd-linear", settings=CreditSettings(optimism=weight, score="sum")) for weight in (0.0, 1.0)
    )
    for one in episodes([8] * 12):
        plain.add_episode(*one)
        brave.add_episode(*one)
    assert (brave.rewards_at(range(8)) > plain.rewards_at(range(8))).all()


def team(length, random, agents=3):
    """Episodes of a team: the reward of each agent, and who acts, one less from step to step."""
    shown = [episode(length, random) for _ in range(agents)]
    together = Shown(*(np.stack(parts, axis=1) for parts in zip(*shown, strict=True)))
    return together, np.arange(agents) < np.maximum(1, agents - np.arange(length))[:, None]


@pytest.mark.parametrize("method", [name if name in ALL_KINDS else long(name) for name in TOGETHER])
def test_every_method_pays_every_agent(method, function):
    credit = assigner(method, function, agents=3, max_steps=6)
    random, numbers, means = np.random.default_rng(0), [], []
    for _ in range(12):
        shown, alive = team(6, random)
        numbers.append(credit.add_episode(*shown, alive=alive))
        means.append((shown.reward * alive).sum(axis=1) / alive.sum(axis=1))
    credit.fit(16)
    assert [one.score for one in credit.store.episodes.values()] == pytest.approx([mean.sum() for mean in means])
    r_hat = credit.rewards_at(numbers)
    assert r_hat.shape == (12, 6, 3)
    assert (r_hat[:, ~alive] == 0).all()
    assert (r_hat[:, alive] != 0).mean() > 0.8
    if method == "lare-rd-shared":
        assert (r_hat[:, 0] == r_hat[:, 0, :1]).all()
    if method != "ircr":
        np.testing.assert_allclose(credit.rewards(*shown[:3])[0], r_hat[-1, 0], rtol=1e-4, atol=1e-5)


def test_a_team_may_have_one_reward_and_stay():
    credit, random = assigner("rd-linear", agents=3, max_steps=6), np.random.default_rng(0)
    for _ in range(12):
        shown, _ = team(6, random)
        credit.add_episode(*shown[:3], shown.reward.mean(axis=1))
    assert credit.store.alive is None
    score = credit.store.episodes[11].score
    assert score == pytest.approx(shown.reward.mean(axis=1).sum())
    credit.add_episode(*shown[:3], 5.0)
    assert credit.store.episodes[12].score == 5.0
    assert (credit.rewards_at([0, -1])[1] == 0).all()
    assert credit.rewards_at([0, -1]).shape == (2, 3)


def test_rows_of_agents_must_have_their_axis():
    credit = assigner("rd-linear", agents=3, max_steps=6)
    with pytest.raises(LareError) as refused:
        credit.add(*ROW)
    assert str(refused.value) == ("before must be rows (steps, 3, 2), and its shape is (2, 2)")


def test_several_threads_may_show_and_ask():
    credit, failed = assigner("rrdu", capacity=10_000), []
    shown = {lane: episodes([7] * 12, seed=lane) for lane in range(4)}

    def show_all(lane):
        try:
            for one in shown[lane]:
                numbers = show(credit, one, lane)
                credit.fit_owed()
                assert credit.rewards_at(numbers).shape == (7,)
                credit.metrics()
        except BaseException as error:  # which a thread would keep to itself
            failed.append(error)

    threads = [threading.Thread(target=show_all, args=(lane,)) for lane in shown]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failed == []
    assert credit.store.dropped == 0
    scores = sorted(one.score for one in credit.store.episodes.values())
    assert scores == sorted(sum(one.reward.tolist()) for each in shown.values() for one in each)
    assert np.isfinite(credit.rewards_at(np.arange(credit.store.steps))).all()


def test_a_function_that_fails_is_a_line_and_the_steps_wait(phi, monkeypatch):
    credit, (one,) = assigner("lare-rd", phi), episodes([4])
    numbers = credit.add_episode(*one)
    with monkeypatch.context() as patched:
        patched.setattr(type(phi), "of_steps", fails)
        with pytest.raises(LareError, match=r"^phi has failed$"):
            credit.rewards_at(numbers)
    credit.look()
    np.testing.assert_array_equal(credit.store.features[numbers], phi.of_steps(*one[:3], "before"))
    assert credit.rewards_at(numbers).shape == (4,)


def fails(*_):
    raise LareError("phi has failed")


def test_it_computes_on_the_host():
    credit = assigner("rd")
    for one in episodes([5] * 3):
        credit.add_episode(*one)
    credit.fit(4)
    assert {device.platform for leaf in jax.tree.leaves(credit.learner.state) for device in leaf.devices()} == {"cpu"}
    assert SMALL.hidden == (8,)


@pytest.mark.parametrize("steps", [[0.5], [-2], ["0"], [True]])
def test_what_is_no_number_of_a_step_is_refused(steps):
    credit = assigner()
    show(credit, episodes([3])[0])
    with pytest.raises(LareError) as refused:
        credit.rewards_at(steps)
    assert str(refused.value) == f"steps must be numbers that `add` has given, or -1, and are {steps}"


@pytest.mark.parametrize("capacity", [0, -1])
def test_a_capacity_is_a_whole_number(capacity):
    with pytest.raises(LareError) as refused:
        assigner(capacity=capacity)
    assert str(refused.value) == f"capacity = {capacity}: it is a whole number, 1 or more"
