"""`CreditAssigner`: it learns from the steps that it was given, and its rewards are those of the newest decoder."""

import threading

import gymnasium
import jax
import numpy as np
import pytest

from helpers.assigner_episodes import TASK, Episode, add_episode, random_episode, random_episodes, small_assigner
from helpers.long_tests import long_case
from helpers.toy_envs import pick_spec
from lare_rl.assigner import decoder_learner
from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import METHODS
from lare_rl.errors import LareError

STEPWISE = [name for name, m in METHODS.items() if m.has_proxy_rewards and not m.needs_whole_episodes]
SINGLE_AGENT = [name for name in STEPWISE if not METHODS[name].multi_agent_only]
MULTI_AGENT = [name for name in STEPWISE if not METHODS[name].single_agent_only]
ALL_KINDS = {"rd", "rrd", "bayes", "lare-rd", "lare-rd-shared", "lare-signs", "ircr", "llm-reward"}
"""Methods with all kinds of inputs, fits and rewards."""


@pytest.fixture
def function(request, phi, reward):
    """The latent function that a method needs."""
    method = METHODS[request.getfixturevalue("method")]
    return (reward if method.phi_kind == "reward" else phi) if method.needs_phi else None


def stored(credit):
    """Return length and score of each stored episode."""
    return [(len(episode.steps), episode.score) for episode in credit.store.episodes.values()]


# Rewards


@pytest.mark.parametrize("method", SINGLE_AGENT)
def test_rewards_of_every_method(method, function):
    credit, episodes = small_assigner(method, function), random_episodes([10] * 12)
    numbers = [add_episode(credit, episode, env_id) for env_id, episode in enumerate(episodes)]
    credit.fit_pending()
    r_hat = credit.rewards_at(numbers)
    assert (r_hat.shape, r_hat.dtype, r_hat.flags.writeable) == ((12, 10), np.float32, True)
    assert np.isfinite(r_hat).all()
    assert r_hat.std() > 0
    if method == "ircr":
        means = np.array([episode.reward.mean() for episode in episodes])
        np.testing.assert_allclose(r_hat[:, 0], (means - means.min()) / np.ptp(means), rtol=1e-5)
        with pytest.raises(LareError, match="rewards_at"):
            credit.rewards(*episodes[0][:3])
    else:
        for episode, expected in zip(episodes, r_hat, strict=True):
            np.testing.assert_allclose(credit.rewards(*episode[:3]), expected, rtol=1e-5, atol=1e-6)
    metrics = credit.metrics()
    assert (metrics["credit/episodes"], metrics["credit/dropped"]) == (12, 0)
    assert (metrics["credit/fits"] > 0) == np.isfinite(metrics["credit/loss"]) == METHODS[method].uses_gradient


@pytest.mark.parametrize("method", ["lare-linear", "rd", "ircr"])
def test_rewards_at_before_the_first_fit(method, function):
    credit, episode = small_assigner(method, function), random_episodes([5])[0]
    numbers = add_episode(credit, episode, end=False)
    assert credit.rewards_at(numbers).tolist() == [0.5 if method == "ircr" else 0.0] * 5
    assert credit.rewards_at([[-1, -1]]).tolist() == [[0.0, 0.0]]
    assert credit.rewards_at([]).shape == (0,)
    assert np.isnan(credit.metrics()["credit/return_r2"])


def test_rewards_recover_the_reward_from_factors_that_contain_it(phi):
    credit = small_assigner("lare-linear", phi)
    for episode in random_episodes([10] * 40):
        credit.add_episode(*episode)
        credit.fit_pending()
    new = random_episodes([50], seed=1)[0]
    np.testing.assert_allclose(credit.rewards(*new[:3]), new.reward, atol=0.01)
    assert credit.metrics()["credit/return_r2"] > 0.9
    assert credit.explanation()


@pytest.mark.parametrize("method", ["rd", "rd-linear"])
def test_rewards_at_uses_the_newest_decoder(method):
    credit, episodes = small_assigner(method), random_episodes([8] * 40)
    for episode in episodes[:10]:
        credit.add_episode(*episode)
    credit.fit(16)
    first = credit.rewards_at(np.arange(10))
    for episode in episodes[10:]:
        credit.add_episode(*episode)
    credit.fit(16)
    assert not np.array_equal(credit.rewards_at(np.arange(10)), first)


def test_rewards_depend_on_the_seed_alone():
    def run(seed):
        credit = small_assigner("rrdu", seed=seed)
        for episode in random_episodes([8] * 5):
            credit.add_episode(*episode)
            credit.fit_pending()
        return credit.rewards_at(np.arange(40))

    np.testing.assert_array_equal(run(3), run(3))
    assert not np.array_equal(run(3), run(4))


def test_rewards_can_be_scaled():
    credit, scaled = small_assigner("rd-linear"), small_assigner("rd-linear", scale_rewards=True)
    episodes = random_episodes([8] * 12)
    for episode in episodes:
        credit.add_episode(*episode)
        scaled.add_episode(*episode)
    scale = np.sqrt(np.mean([episode.reward.mean() ** 2 for episode in episodes]))
    np.testing.assert_allclose(scaled.rewards_at(range(8)) * scale, credit.rewards_at(range(8)), rtol=1e-4)


def test_optimism_raises_rewards():
    plain, optimistic = (
        small_assigner("rd-linear", settings=CreditSettings(optimism=weight, score="sum")) for weight in (0.0, 1.0)
    )
    for episode in random_episodes([8] * 12):
        plain.add_episode(*episode)
        optimistic.add_episode(*episode)
    assert (optimistic.rewards_at(range(8)) > plain.rewards_at(range(8))).all()


@pytest.mark.parametrize("steps", [[0.5], [-2], ["0"], [True]])
def test_rewards_at_refuses_what_is_no_step_number(steps):
    credit = small_assigner()
    add_episode(credit, random_episodes([3])[0])
    with pytest.raises(LareError, match="numbers"):
        credit.rewards_at(steps)


# Learning


@pytest.mark.parametrize("method", ["lare-bayes", "rd", "lare-rrdu", "llm-reward"])
def test_steps_episodes_and_scores_give_the_same_rewards(method, function):
    stepwise, whole, scored = (small_assigner(method, function) for _ in range(3))
    for episode in random_episodes([8, 3, 6, 8, 5] * 3):
        add_episode(stepwise, episode)
        whole.add_episode(*episode)
        scored.add_episode(*episode[:3], episode.reward.sum())
        for credit in (stepwise, whole, scored):
            credit.fit_pending()
    steps = np.arange(stepwise.store.steps)
    np.testing.assert_array_equal(whole.store.features, stepwise.store.features)
    np.testing.assert_array_equal(whole.rewards_at(steps), stepwise.rewards_at(steps))
    np.testing.assert_allclose(scored.rewards_at(steps), stepwise.rewards_at(steps), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("method", ["lare-bayes", "lare-linear"])
def test_return_r2_needs_eight_predicted_returns(method, phi):
    # From one episode, a decoder in closed form learns the mean reward only: the third return is the first that is predicted.
    credit = small_assigner(method, phi)
    is_known = []
    for episode in random_episodes([10] * 12):
        credit.add_episode(*episode)
        is_known.append(bool(np.isfinite(credit.metrics()["credit/return_r2"])))
    assert is_known == [False] * 9 + [True] * 3


@pytest.mark.parametrize("is_asked_often", [True, False])
def test_return_r2_does_not_depend_on_when_it_is_asked(is_asked_often, phi):
    credit = small_assigner("lare-linear", phi)
    for episode in random_episodes([10] * 40):
        credit.add_episode(*episode)
        if is_asked_often:
            credit.metrics()
    assert 0.9 < credit.metrics()["credit/return_r2"] <= 1
    assert float(credit.learner.decoder.closed_form.n_fitted) > 38


@pytest.mark.parametrize("score", ["sum", "average"])
@pytest.mark.parametrize("setting", ["auto", "sum", "average"])
def test_score_type_is_found_and_rewards_add_up_to_the_score(score, setting, phi):
    lengths = np.random.default_rng(0).integers(3, 13, size=80)
    credit = small_assigner("lare-linear", phi, settings=CreditSettings(score=setting), capacity=2000)
    scores, numbers = [], []
    for episode in random_episodes(lengths):
        scores.append(episode.reward.sum() if score == "sum" else episode.reward.mean())
        numbers.append(credit.add_episode(*episode[:3], scores[-1]))
        credit.fit_pending()
    assert credit.score_type == credit.form == (score if setting == "auto" else setting)
    error = np.array([credit.rewards_at(steps).sum() for steps in numbers]) - scores
    assert (np.abs(error).max() < 0.05 * np.std(scores)) == (setting in ("auto", score))
    observation, action, next_observation, _ = random_episodes([5])[0]
    short, long = (credit.rewards(observation, action, next_observation, length=[n] * 5) for n in (10, 20))
    np.testing.assert_allclose(short, (2 if credit.score_type == "average" else 1) * long, rtol=1e-5)
    with pytest.raises(LareError, match="length"):
        credit.rewards(observation, action, next_observation, length=3)


def test_score_type_of_the_task():
    credit = CreditAssigner("rd-linear", task=TASK.model_copy(update={"score": "average"}))
    assert credit.config.settings.score == credit.score_type == "average"


def test_fit_pending_updates_in_chunks():
    credit = small_assigner("rd", fits_per_step=2.0)
    add_episode(credit, random_episodes([20])[0], end=False)
    credit.fit_pending()
    assert credit.learner.n_updates == 0
    credit.end(0)
    credit.fit_owed()  # the earlier name
    assert credit.learner.n_updates == 32  # 2 * 20, in chunks of 16
    credit.fit_pending()
    assert credit.learner.n_updates == 32
    credit.fit(5)
    assert credit.learner.n_updates == 37


def test_fit_pending_makes_a_bounded_number_of_updates():
    credit = small_assigner("rd", fits_per_step=100.0)
    add_episode(credit, random_episodes([20])[0])
    credit.fit_pending()
    assert credit.learner.n_updates == decoder_learner.MAX_PENDING_UPDATES


@pytest.mark.parametrize("method", ["rd", "rd-linear", "ircr"])
def test_fit_without_episodes(method):
    credit = small_assigner(method)
    credit.fit(3)
    credit.fit_pending()
    assert credit.learner.n_updates == 0
    assert credit.explanation() == []


def test_forget_is_false_for_logs():
    log, loop = (small_assigner("rd-linear", capacity=500, forget=forget) for forget in (False, True))
    for episode in random_episodes(np.random.default_rng(4).integers(1, 12, size=400)):
        log.add_episode(*episode)
        loop.add_episode(*episode)
        log.fit_pending(), loop.fit_pending()
    log.metrics(), loop.metrics()
    n_log, n_loop = (
        float(np.sum(credit.learner.decoder.closed_form.sufficient_statistics.n_episodes)) for credit in (log, loop)
    )
    assert n_log == 400
    assert n_loop < 300


def test_learning_in_chunks(monkeypatch, phi):
    (steps,) = random_episodes([700])
    assigners = [small_assigner("lare-linear", phi)]
    monkeypatch.setattr(decoder_learner, "CHUNK_ROWS", 64)
    assigners.append(small_assigner("lare-linear", phi))
    for credit in assigners:
        env_ids = (np.arange(700) // 10).tolist()
        numbers = credit.add(*steps, np.arange(700) % 10 == 9, np.zeros(700), env_ids=env_ids)
        credit.fit()
        assert len(credit.store.episodes) == 70
    whole, chunked = assigners
    np.testing.assert_array_equal(chunked.store.features, whole.store.features)
    np.testing.assert_allclose(chunked.rewards_at(numbers), whole.rewards_at(numbers), atol=1e-3)


def test_learning_runs_on_the_cpu():
    credit = small_assigner("rd")
    for episode in random_episodes([5] * 3):
        credit.add_episode(*episode)
    credit.fit(4)
    leaves = jax.tree.leaves(credit.learner.decoder)
    assert {device.platform for leaf in leaves for device in leaf.devices()} == {"cpu"}


def test_failing_phi_loses_no_steps(phi, monkeypatch):
    credit, (episode,) = small_assigner("lare-rd", phi), random_episodes([4])
    numbers = credit.add_episode(*episode)

    def fail(*_):
        raise LareError("phi has failed")

    with monkeypatch.context() as patch:
        patch.setattr(type(phi), "step_factors", fail)
        with pytest.raises(LareError, match="phi has failed"):
            credit.rewards_at(numbers)
    assert credit.rewards_at(numbers).shape == (4,)
    np.testing.assert_array_equal(credit.store.features[numbers], phi.step_factors(*episode[:3], "before"))


def test_several_threads_may_use_an_assigner():
    credit, errors = small_assigner("rrdu", capacity=10_000), []
    episodes = {env_id: random_episodes([7] * 12, seed=env_id) for env_id in range(4)}

    def play(env_id):
        try:
            for episode in episodes[env_id]:
                numbers = add_episode(credit, episode, env_id)
                credit.fit_pending()
                assert credit.rewards_at(numbers).shape == (7,)
                credit.metrics()
        except BaseException as error:  # a thread would not raise it
            errors.append(error)

    threads = [threading.Thread(target=play, args=(env_id,)) for env_id in episodes]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    assert credit.store.dropped == 0
    expected = [sum(episode.reward.tolist()) for env_episodes in episodes.values() for episode in env_episodes]
    assert sorted(score for _, score in stored(credit)) == sorted(expected)
    assert np.isfinite(credit.rewards_at(np.arange(credit.store.steps))).all()


# Steps and episodes


def test_add_interleaves_environments():
    credit, episodes = small_assigner(), random_episodes([4, 2, 3, 5])
    remaining = {env_id: list(zip(*episode, strict=True)) for env_id, episode in zip("abcd", episodes, strict=True)}
    while remaining:
        rows = [steps.pop(0) for steps in remaining.values()]
        ended = [not steps for steps in remaining.values()]
        credit.add(*map(np.array, zip(*rows, strict=True)), ended, np.zeros(len(rows)), env_ids=list(remaining))
        remaining = {env_id: steps for env_id, steps in remaining.items() if steps}
    assert sorted(stored(credit)) == sorted((len(e.reward), sum(e.reward.tolist())) for e in episodes)
    assert credit.store.dropped == 0


def test_add_gives_no_number_to_rows_that_are_not_valid():
    credit, (episode,) = small_assigner(), random_episodes([3])
    rows = [np.repeat(array[:1], 3, axis=0) for array in episode]
    rows[0][1] = np.nan
    numbers = credit.add(*rows, [False, True, True], [False] * 3, valid=[True, False, True], lanes=[0, 1, 2])
    assert numbers.tolist() == [0, -1, 1]
    assert credit.store.ended == 1
    assert list(credit.store.running) == [0]
    assert credit.rewards_at(numbers).shape == (3,)
    assert credit.add(*rows, [True] * 3, [False] * 3, valid=[False] * 3).tolist() == [-1] * 3


def test_add_copies_arrays_that_an_environment_reuses():
    credit, (episode,) = small_assigner(), random_episodes([6])
    observation, next_observation = np.zeros((1, 2), np.float32), np.zeros((1, 2), np.float32)
    numbers = []
    for t in range(6):
        observation[:], next_observation[:] = episode.observation[t], episode.next_observation[t]
        rows = observation, episode.action[[t]], next_observation, episode.reward[[t]]
        numbers += credit.add(*rows, [t == 5], [False]).tolist()
    assert credit.store.dropped == 0
    credit.rewards_at(numbers)
    expected = np.hstack([episode.next_observation, episode.action])
    np.testing.assert_array_equal(credit.store.features[numbers], expected)


def test_add_after_an_unseen_reset_drops_the_episode():
    credit, (first, second) = small_assigner(), random_episodes([5, 4])
    dropped = add_episode(credit, first, end=False)
    add_episode(credit, second)
    assert credit.metrics()["credit/dropped"] == 1
    assert stored(credit) == [(4, sum(second.reward.tolist()))]
    assert credit.rewards_at(dropped).shape == (5,)


def test_drop():
    credit, (first, second) = small_assigner(), random_episodes([5, 4])
    add_episode(credit, first, end=False)
    credit.drop(0)
    credit.drop("unknown")
    assert credit.metrics()["credit/dropped"] == 1
    add_episode(credit, second)
    assert [length for length, _ in stored(credit)] == [4]


def test_end_with_late_scores():
    credit, episodes = small_assigner(), random_episodes([3, 5, 4])
    for i, episode in enumerate(episodes):
        add_episode(credit, episode, ("game", i), end=False)
    credit.end(("game", 1), 7.0)
    credit.end(("game", 0))
    assert stored(credit) == [(5, 7.0), (3, sum(episodes[0].reward.tolist()))]
    assert list(credit.store.running) == [("game", 2)]


@pytest.mark.parametrize(("env_id", "score"), [("x", None), (0, float("nan")), (0, float("inf"))])
def test_end_refuses(env_id, score):
    credit, (episode,) = small_assigner(), random_episodes([3])
    add_episode(credit, episode, end=False)
    with pytest.raises(LareError, match=repr(env_id)):
        credit.end(env_id, score)
    credit.end(0)


def test_capacity_removes_the_oldest_episodes():
    credit = small_assigner(capacity=20)
    numbers = [add_episode(credit, episode) for episode in random_episodes([6] * 5)]
    assert [episode.steps.tolist() for episode in credit.store.episodes.values()] == numbers[2:]
    credit.fit()
    assert np.isfinite(credit.rewards_at(numbers[2:])).all()
    with pytest.raises(LareError, match=r"step 6 .*capacity = 20"):
        credit.rewards_at(numbers[1])
    with pytest.raises(LareError, match=r"21 steps .*capacity"):
        add_episode(credit, random_episodes([21])[0])
    with pytest.raises(LareError, match=r"21 steps .*capacity"):
        credit.add_episode(*random_episodes([21])[0])


def test_add_episode_needs_no_consecutive_observations():
    credit = small_assigner()
    credit.add_episode(np.zeros((5, 2)), np.zeros((5, 1)), np.ones((5, 2)), 1.0)
    assert (credit.store.ended, credit.store.dropped) == (1, 0)


ROWS = {
    "observation": np.zeros((2, 2)),
    "action": np.zeros((2, 1)),
    "next_observation": np.zeros((2, 2)),
    "reward": np.zeros(2),
    "terminated": np.zeros(2),
    "truncated": np.zeros(2),
}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observation": np.zeros((2, 3))}, r"observation .*\(2, 3\).* 2 numbers"),
        ({"observation": np.zeros(2)}, r"observation .*\(2,\).*\(steps, 2\)"),
        ({"action": np.zeros((3, 1))}, r"action .*\(3, 1\).*\(steps, 1\)"),
        ({"next_observation": np.zeros((2, 1))}, r"next_observation .*\(2, 1\).* 2 numbers"),
        ({"reward": np.zeros((2, 1))}, r"reward .*\(2, 1\).* 2 steps"),
        ({"terminated": np.zeros(3)}, r"terminated .*\(3,\).* 2 steps"),
        ({"truncated": False}, r"truncated .*\(\).* 2 steps"),
        ({"valid": [True]}, r"valid .*\(1,\).* 2 steps"),
        ({"env_ids": [0]}, "env_ids has 1 .* 2 steps"),
        ({"alive": np.ones((2, 1))}, r"alive .*\(2, 1\)"),
        ({"observation": [[0, 0], [0, np.nan]]}, "observation of row 1 .*nan"),
        ({"action": [[np.inf], [0]]}, "action of row 0 .*inf"),
        ({"next_observation": [[0, 0], [0, 1e300]]}, "next_observation of row 1 .*inf"),
        ({"reward": [0, -np.inf], "valid": [False, True]}, "reward of row 1 .*-inf"),
    ],
)
def test_add_refuses(changes, message):
    credit = small_assigner()
    with pytest.raises(LareError, match=message):
        credit.add(**(ROWS | changes))
    assert credit.store.steps == 0
    credit.add(**ROWS)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"reward": np.nan}, "score is nan"),
        ({"reward": [0.0, np.inf]}, "reward of row 1 .*inf"),
        ({"next_observation": np.full((2, 2), np.nan)}, "next_observation of row 0 .*nan"),
        ({"reward": [1.0]}, r"reward .*\(1,\).* 2 steps"),
        (
            {name: np.zeros((0, size)) for name, size in (("observation", 2), ("action", 1), ("next_observation", 2))},
            "no step",
        ),
    ],
)
def test_add_episode_refuses(changes, message):
    credit = small_assigner()
    values = {name: ROWS[name] for name in ("observation", "action", "next_observation")} | {"reward": 1.0}
    with pytest.raises(LareError, match=message):
        credit.add_episode(**(values | changes))
    assert credit.store.steps == 0


# Configuration


@pytest.mark.parametrize(
    ("method", "changes", "message"),
    [
        ("dense", {}, "assigns no credit"),
        ("episodic", {}, "assigns no credit"),
        ("arel", {"agents": 2, "max_steps": 5}, "lare_rl.train"),
        ("lare-rd", {}, "needs a phi"),
        ("diaster", {"agents": 2, "max_steps": 5}, "2 agents"),
        ("rd", {"agents": 2}, "max_steps"),
        ("ircr", {"scale_rewards": True}, "scale_rewards"),
        ("rd-linear", {"observation_space": 10_000}, "1024 .*10001"),
        ("rrdu", {"settings": CreditSettings(drawn_steps=8, steps=4)}, r"steps = 4,.*drawn_steps = 8"),
        ("rd", {"action_space": None}, "action_space"),
        ("rd", {"task": TASK, "observation_space": 3}, "observation_space .*3 .*observation_size = 2"),
        ("rd", {"capacity": 0}, "capacity = 0"),
        ("rd", {"capacity": -1}, "capacity = -1"),
    ],
)
def test_init_refuses(method, changes, message):
    with pytest.raises(LareError, match=message):
        small_assigner(method, **changes)


@pytest.mark.parametrize(
    ("method", "kind", "changes", "message"),
    [
        ("rd", "factors", {}, "no phi"),
        ("lare-rd", "reward", {}, "'factors'.*'reward'"),
        ("lare-rd", "factors", {"task": None, "observation_space": 2, "action_space": 1}, "task=task"),
        ("llm-reward", "reward", {"judges": "both"}, "judges"),
        ("lare-rd-shared", "factors", {}, "single agent"),
    ],
)
def test_init_refuses_functions(method, kind, changes, message, phi, reward):
    with pytest.raises(LareError, match=message):
        small_assigner(method, phi if kind == "factors" else reward, **changes)


def test_spaces_of_gymnasium():
    spaces = gymnasium.spaces
    observation_space = spaces.Dict(place=spaces.Box(-1, 1, (2,)), mode=spaces.Discrete(3))
    credit = CreditAssigner("rd", observation_space=observation_space, action_space=spaces.Discrete(4, start=1))
    observation = {"place": np.ones((2, 2)), "mode": np.array([0, 2])}
    credit.rewards_at(credit.add(observation, np.array([1, 4]), observation, [0, 0], [False] * 2, [False] * 2))
    rows = [[1, 1, 1, 0, 0], [1, 1, 0, 0, 1]]
    expected = np.hstack([rows, [[1, 0, 0, 0], [0, 0, 0, 1]], np.zeros((2, 5))])
    np.testing.assert_array_equal(credit.store.features[:2], expected)


def test_task_with_discrete_actions():
    credit = CreditAssigner("bayes", task=pick_spec())
    steps = np.eye(4)[:2], np.array([3, 0]), np.eye(4)[1:3], [0, 0], [False] * 2, [False] * 2
    credit.rewards_at(credit.add(*steps))
    np.testing.assert_array_equal(credit.store.features[:2, 4:], np.eye(4)[[3, 0]])


@pytest.mark.parametrize("judges", ["before", "after", "both"])
def test_judges(judges, phi):
    (episode,) = random_episodes([4])
    factors, raw = small_assigner("lare-rd", phi, judges=judges), small_assigner("bayes", judges=judges)
    for credit in (factors, raw):
        credit.rewards_at(credit.add_episode(*episode))
    np.testing.assert_array_equal(factors.store.features[:4], phi.step_factors(*episode[:3], judges))
    before, after = episode.observation, episode.next_observation
    observations = {"before": [before], "after": [after], "both": [before, after]}[judges]
    expected = np.concatenate([*observations, episode.action], axis=1)
    np.testing.assert_array_equal(raw.store.features[:4], expected)


# Many agents


def team_episode(length, random, agents=3):
    """Return an episode of a team with the reward of each agent, and which agents are alive: one less from step to step."""
    episodes = [random_episode(length, random) for _ in range(agents)]
    episode = Episode(*(np.stack(arrays, axis=1) for arrays in zip(*episodes, strict=True)))
    return episode, np.arange(agents) < np.maximum(1, agents - np.arange(length))[:, None]


@pytest.mark.parametrize("method", [name if name in ALL_KINDS else long_case(name) for name in MULTI_AGENT])
def test_rewards_of_many_agents(method, function):
    credit = small_assigner(method, function, agents=3, max_steps=6)
    random, numbers, returns = np.random.default_rng(0), [], []
    for _ in range(12):
        episode, alive = team_episode(6, random)
        numbers.append(credit.add_episode(*episode, alive=alive))
        returns.append(((episode.reward * alive).sum(axis=1) / alive.sum(axis=1)).sum())
    credit.fit(16)
    assert [score for _, score in stored(credit)] == pytest.approx(returns)
    r_hat = credit.rewards_at(numbers)
    assert r_hat.shape == (12, 6, 3)
    assert (r_hat[:, ~alive] == 0).all()
    assert (r_hat[:, alive] != 0).mean() > 0.8
    if method == "lare-rd-shared":
        assert (r_hat[:, 0] == r_hat[:, 0, :1]).all()
    if method != "ircr":
        np.testing.assert_allclose(credit.rewards(*episode[:3])[0], r_hat[-1, 0], rtol=1e-4, atol=1e-5)


def test_team_with_one_reward():
    credit, random = small_assigner("rd-linear", agents=3, max_steps=6), np.random.default_rng(0)
    for _ in range(12):
        episode, _ = team_episode(6, random)
        credit.add_episode(*episode[:3], episode.reward.mean(axis=1))
    assert credit.store.alive is None
    assert credit.store.episodes[11].score == pytest.approx(episode.reward.mean(axis=1).sum())
    credit.add_episode(*episode[:3], 5.0)
    assert credit.store.episodes[12].score == 5.0
    assert (credit.rewards_at([0, -1])[1] == 0).all()
    assert credit.rewards_at([0, -1]).shape == (2, 3)
    with pytest.raises(LareError, match=r"\(2, 2\).*\(steps, 3, 2\)"):
        credit.add(**ROWS)
