"""`CreditAssigner`: it learns from the steps that it gets, and its rewards are those of the newest decoder."""

import re
import threading

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.spaces import Box

from helpers.assigner_episodes import (
    SMALL_CREDIT,
    TASK,
    Episode,
    add_episode,
    random_episode,
    random_episodes,
    small_assigner,
)
from helpers.long_tests import long_case
from helpers.toy_envs import pick_spec
from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.assigner.decoder_learner import MAX_FIRST_UPDATES
from lare_rl.assigner.explain import explain
from lare_rl.credit import decoder_state
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import METHODS
from lare_rl.errors import LareError
from lare_rl.latent.function import verify_function

METHODS_FOR_STEPS = [m for m in METHODS.values() if m.has_proxy_rewards and not m.decoder_kind.whole_episodes]
SINGLE_AGENT_KINDS = {"rrdu", "diaster", "lare-bayes", "lare-signs", "ircr", "llm-reward"}
MANY_AGENT_KINDS = {"bayes", "lare-rd-shared", "ircr"}
"""Methods with all kinds of inputs, batches, fits and rewards."""


def cases(methods, kinds):
    return [method.name if method.name in kinds else long_case(method.name) for method in methods]


@pytest.fixture
def function(request, phi, reward):
    """The latent function that a method needs."""
    method = METHODS[request.getfixturevalue("method")]
    return (reward if method.phi_kind == "reward" else phi) if method.needs_phi else None


def stored(credit):
    """Return length and score of each stored episode."""
    return [(len(episode.step_ids), episode.return_) for episode in credit.store.episodes.values()]


def add_episodes(credit, episodes):
    for episode in episodes:
        credit.add_episode(*episode)


@pytest.mark.parametrize("method", cases([m for m in METHODS_FOR_STEPS if not m.multi_agent_only], SINGLE_AGENT_KINDS))
def test_rewards_of_every_method(method, function):
    credit, episodes = small_assigner(method, function), random_episodes([8] * 12)
    credit.fit(3)
    first = add_episode(credit, episodes[0], "first", end=False)
    credit.fit_pending()
    before = {"ircr": 0.5, "llm-reward": episodes[0].reward}.get(method, 0.0)
    np.testing.assert_allclose(credit.rewards_at(first), np.broadcast_to(before, 8), rtol=1e-5)
    assert credit.rewards_at([[-1, -1]]).tolist() == [[0.0, 0.0]]
    assert credit.rewards_at([]).shape == (0,)
    assert credit.rewards_at(5).shape == ()
    assert np.isnan(credit.metrics()["credit/return_r2"])
    assert credit.explanation() == []
    assert credit.learner.n_updates == 0
    credit.end("first")
    numbers = [first, *(add_episode(credit, episode, env_id) for env_id, episode in enumerate(episodes[1:]))]
    credit.fit_pending()
    r_hat = credit.rewards_at(numbers)
    assert (r_hat.shape, r_hat.dtype, r_hat.flags.writeable) == ((12, 8), np.float32, True)
    assert np.isfinite(r_hat).all()
    assert r_hat.std() > 0
    if method == "ircr":
        means = np.array([episode.reward.mean() for episode in episodes])
        np.testing.assert_allclose(r_hat[:, 0], (means - means.min()) / np.ptp(means), rtol=1e-5)
        running = add_episode(credit, episodes[0], "running", end=False)
        assert credit.rewards_at(running).tolist() == [0.5] * 8
        with pytest.raises(LareError, match="rewards_at"):
            credit.rewards(*episodes[0][:3])
    else:
        n_compared = 7 if credit.config.spec.is_exact else 8  # the residual at the last step needs the return
        for episode, expected in zip(episodes, r_hat, strict=True):
            r_hat_again = credit.rewards(*episode[:3], begins=np.arange(8) == 0)
            np.testing.assert_allclose(r_hat_again[:n_compared], expected[:n_compared], rtol=1e-5, atol=1e-6)
    metrics = credit.metrics()
    assert (metrics["credit/episodes"], metrics["credit/dropped"]) == (12, 0)
    assert (metrics["credit/fits"] > 0) == np.isfinite(metrics["credit/loss"]) == METHODS[method].uses_gradient


def test_rewards_depend_on_the_seed_and_the_newest_decoder():
    assigners = [small_assigner("rd", seed=seed) for seed in (3, 3, 4)]
    for credit in assigners:
        add_episodes(credit, random_episodes([8] * 5))
        credit.fit(16)
    first, same, other = (credit.rewards_at(np.arange(40)) for credit in assigners)
    np.testing.assert_array_equal(first, same)
    assert not np.array_equal(first, other)
    assigners[0].fit(16)
    assert not np.array_equal(assigners[0].rewards_at(np.arange(40)), first)
    leaves = jax.tree.leaves(credit.learner.decoder)
    assert {device.platform for leaf in leaves for device in leaf.devices()} == {"cpu"}


def test_rewards_can_be_scaled():
    episodes = random_episodes([8] * 12)
    assigners = [small_assigner(), small_assigner(scale_rewards=True)]
    for credit in assigners:
        add_episodes(credit, episodes)
    plain, scaled = (credit.rewards_at(range(8)) for credit in assigners)
    scale = np.sqrt(np.mean([episode.reward.mean() ** 2 for episode in episodes]))
    np.testing.assert_allclose(scaled * scale, plain, rtol=1e-4)


@pytest.mark.long
def test_explanation_of_noise():
    """A fit to prefixes has a column for the time, which is not the return."""
    credit, random = small_assigner("bayes-progress"), np.random.default_rng(0)
    for *steps, _ in random_episodes(random.integers(9, 17, size=100)):
        credit.add_episode(*steps, random.normal())
    credit.learner.learn_returns()
    assert explain(credit.learner).total_r2 < 0.3


@pytest.mark.parametrize("start_value", [True, long_case(False)])
def test_no_step_is_paid_for_the_start_value_of_a_sum(start_value, phi):
    settings = SMALL_CREDIT.model_copy(update={"score": "auto", "start_value": start_value})
    credit, episodes = small_assigner("lare-linear", phi, settings=settings), random_episodes([14, 3, 8, 5] * 15)
    for *steps, reward in episodes:
        credit.add_episode(*steps, reward.sum() - 50)
    reward = np.concatenate([episode.reward for episode in episodes])
    error = np.abs(credit.rewards_at(np.arange(len(reward))) - reward).max()
    assert (credit.score_type == "sum", error < 0.05) == (start_value, start_value)
    assert credit.metrics()["credit/return_r2"] > 0.9 or not start_value


@pytest.mark.long
@pytest.mark.parametrize("groups", [False, True])
def test_gradient_decoders_pay_no_step_for_the_start_value(groups):
    settings = SMALL_CREDIT.model_copy(update={"score": "auto", "learning_rate": 0.01, "batch_steps": 100})
    credit = small_assigner("rd", settings=settings, groups=groups)
    episodes = random_episodes([14, 3, 8, 5] * 15)
    for i, (*steps, reward) in enumerate(episodes):
        credit.add_episode(
            *steps, reward.sum() - 50 + 0.5 * groups * (i % 2) * len(reward), group=i % 2 if groups else None
        )
        if i % 10 == 9:
            credit.fit(150)
    assert credit.score_type == "sum"
    reward = np.concatenate([episode.reward for episode in episodes])
    assert np.abs(credit.rewards_at(np.arange(len(reward))) - reward).mean() < 0.5
    assert credit.metrics()["credit/return_r2"] > 0.8


@pytest.mark.long
def test_start_value_of_long_episodes():
    credit, random = (
        small_assigner("bayes", settings=SMALL_CREDIT.model_copy(update={"score": "auto"}), capacity=400_000),
        np.random.default_rng(0),
    )
    for length in random.integers(2900, 3100, size=60):
        *steps, _ = random_episode(length, random)
        credit.add_episode(*steps, 0.01 * steps[2][:, 0].sum() + 0.1 * random.normal() + 100)
    assert float(decoder_state.start_value(credit.learner.decoder)) == pytest.approx(100, abs=1)


@pytest.mark.parametrize(("setting", "score"), [("auto", "sum"), ("auto", "average"), ("average", "sum")])
def test_score_type_is_found_and_rewards_add_up_to_the_score(setting, score, phi):
    lengths = np.random.default_rng(0).integers(5, 9, size=80)
    settings = SMALL_CREDIT.model_copy(update={"score": setting})
    credit = small_assigner("lare-linear", phi, settings=settings)
    scores, numbers = [], []
    for episode in random_episodes(lengths):
        scores.append(episode.reward.sum() if score == "sum" else episode.reward.mean())
        numbers.append(credit.add_episode(*episode[:3], scores[-1]))
    assert credit.score_type == credit.form == (score if setting == "auto" else setting)
    mean = np.average(scores, weights=lengths) if credit.score_type == "average" else 0  # no step is paid for it
    error = np.array([credit.rewards_at(steps).sum() for steps in numbers]) - (np.array(scores) - mean)
    assert (np.abs(error).max() < 0.05 * np.std(scores)) == (setting in ("auto", score))
    *steps, _ = random_episodes([5])[0]
    short, long = (credit.rewards(*steps, length=[n] * 5) for n in (10, 20))
    np.testing.assert_allclose(short, (2 if credit.score_type == "average" else 1) * long, rtol=1e-5)
    for length in (0, -1, 2.9, np.nan, np.inf):
        with pytest.raises(LareError, match=r"length of row 1 .* number of steps"):
            credit.rewards(*steps, length=[2, length, 2, 2, 2])
    for numbers in ([0.5], [-2], ["0"], [True], None, [[0], [1, 2]]):
        with pytest.raises(LareError, match="numbers"):
            credit.rewards_at(numbers)


def test_fit_pending_makes_chunks_of_updates_and_not_too_many():
    credit, (episode,) = small_assigner("rd", fits_per_step=2.0), random_episodes([20])
    add_episode(credit, episode, end=False)
    credit.fit_pending()
    assert credit.learner.n_updates == 0
    credit.end(0)
    credit.fit_owed()  # the earlier name
    assert credit.learner.n_updates == 32  # 2 * 20, in chunks of 16
    credit.fit_pending()
    assert credit.learner.n_updates == 32
    credit.fit(5)
    assert credit.learner.n_updates == 37
    eager = small_assigner("rd", fits_per_step=100.0)
    add_episode(eager, episode)
    eager.fit_pending()
    assert eager.learner.n_updates == MAX_FIRST_UPDATES


def test_forget_is_false_for_logs():
    n_fitted = []
    for forget in (False, True):
        credit = small_assigner(capacity=500, forget=forget)
        for episode in random_episodes(np.random.default_rng(4).integers(5, 9, size=200)):
            credit.add_episode(*episode)
            credit.fit_pending()
        credit.metrics()
        n_fitted.append(float(np.sum(credit.learner.decoder.closed_form.sufficient_statistics.n_episodes)))
    assert n_fitted[0] == 200
    assert n_fitted[1] < 150


def test_many_steps_at_once_are_learned_in_chunks():
    """10,000 steps are more than one call of a compiled function takes."""
    (steps,) = random_episodes([10_000])
    ended, never = np.arange(10_000) % 20 == 19, np.zeros(10_000, bool)
    env_ids = (np.arange(10_000) // 20).tolist()
    at_once, chunked = small_assigner(capacity=10_000), small_assigner(capacity=10_000)
    at_once.add(*steps, ended, never, env_ids=env_ids)
    for rows in np.array_split(np.arange(10_000), 10):
        chunked.add(*(array[rows] for array in (*steps, ended, never)), env_ids=[env_ids[row] for row in rows])
    for credit in (at_once, chunked):
        credit.fit()
        assert float(np.sum(credit.learner.decoder.closed_form.sufficient_statistics.n_episodes)) == 500
    np.testing.assert_array_equal(chunked.store.inputs, at_once.store.inputs)
    r_hat = at_once.rewards_at(np.arange(10_000))
    np.testing.assert_allclose(chunked.rewards_at(np.arange(10_000)), r_hat, atol=0.1 * r_hat.std())


def test_step_with_an_infinite_factor_costs_only_the_episodes_that_wait(chase, tmp_path):
    first, second, third = random_episodes([4, 5, 6])
    second[0][2] = second[2][1] = 1e7
    phi = verify_function(
        "def evaluation_func(o, a):\n    return [o[:, :1] + np.exp(np.maximum(o[:, 1:] - 1e6, 0))]", chase
    )
    credit = small_assigner("lare-linear", phi)
    credit.add_episode(*(np.minimum(array, 0) for array in first))
    credit.fit()
    bad = credit.add_episode(*second)
    credit.add([[0.0, 0.0]], [[0.0]], [[0.0, 0.0]], [0.0], [False], [False])
    with pytest.raises(LareError, match=r"factor_1. is inf"):
        credit.rewards_at(bad)
    assert credit.get_state(episodes=False).arrays["counts"][2] == credit.store.dropped == 2
    np.testing.assert_array_equal(credit.store.inputs[bad], 0)
    credit.add([[0.0, 0.0]], [[0.0]], [[0.0, 0.0]], [7.0], [True], [False])  # the rest of an episode that waited
    numbers = credit.add_episode(*(np.minimum(array, 0) for array in third))
    credit.fit()
    assert np.isfinite(credit.rewards_at(numbers)).all()
    assert credit.metrics()["credit/dropped"] == 2
    assert credit.metrics()["credit/episodes"] == 3
    assert [len(episode.step_ids) for episode in credit.store.episodes.values()] == [4, 6]
    for episode in random_episodes([6] * 8, seed=1):
        credit.add_episode(*episode)
    credit.fit()
    assert float(credit.learner.decoder.closed_form.n_steps) > 30  # the sums are still rebuilt
    credit.save(tmp_path / "credit")
    loaded = CreditAssigner.load(tmp_path / "credit")
    assert list(loaded.store.episodes) == [0, *range(2, 11)]
    assert loaded.store.n_forgotten == 1


def test_several_threads_may_use_an_assigner():
    credit, errors = small_assigner("rd"), []
    episodes = {env_id: random_episodes([7] * 8, seed=env_id) for env_id in range(4)}

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
    assert np.isfinite(credit.rewards_at(np.arange(credit.store.n_added))).all()


def test_add_gives_no_number_to_rows_that_are_not_valid():
    credit, (episode,) = small_assigner(), random_episodes([3])
    rows = [np.repeat(array[:1], 3, axis=0) for array in episode]
    rows[0][1] = np.nan
    numbers = credit.add(*rows, [False, True, True], [False] * 3, valid=[True, False, True], lanes=[0, 1, 2])
    assert numbers.tolist() == [0, -1, 1]
    assert (credit.store.n_ended, list(credit.store.running)) == (1, [0])
    assert credit.rewards_at(numbers).shape == (3,)
    assert credit.add(*rows, [True] * 3, [False] * 3, valid=[False] * 3).tolist() == [-1] * 3


def test_add_copies_arrays_that_an_environment_reuses():
    credit, (episode,) = small_assigner(), random_episodes([6])
    rows = [np.zeros_like(array[:1]) for array in episode]
    for t in range(6):
        for row, array in zip(rows, episode, strict=True):
            row[:] = array[t]
        numbers = credit.add(*rows, [t == 5], [False])
    credit.rewards_at(numbers)
    assert credit.store.dropped == 0
    np.testing.assert_array_equal(credit.store.inputs[:6], np.hstack([episode.next_observation, episode.action]))


def test_end_and_drop():
    """An episode ends with a late score, or is abandoned: if it is dropped, or if a reset was not seen."""
    credit, episodes = small_assigner(), random_episodes([3, 5, 4])
    for i, episode in enumerate(episodes):
        add_episode(credit, episode, ("game", i), end=False)
    credit.end(("game", 1), 7.0)
    credit.end(("game", 0))
    assert stored(credit) == [(5, 7.0), (3, sum(episodes[0].reward.tolist()))]
    assert list(credit.store.running) == [("game", 2)]
    for env_id, score in (("x", None), (("game", 2), float("nan")), (("game", 2), float("inf"))):
        with pytest.raises(LareError, match=str(env_id[0])):
            credit.end(env_id, score)
    abandoned = add_episode(credit, episodes[0], ("game", 2), end=False)
    credit.drop(("game", 2))
    credit.drop("unknown")
    add_episode(credit, episodes[1], ("game", 2))
    assert stored(credit)[2:] == [(5, sum(episodes[1].reward.tolist()))]
    assert credit.metrics()["credit/dropped"] == 2
    assert credit.rewards_at(abandoned).shape == (3,)


def test_capacity_removes_the_oldest_episodes():
    credit = small_assigner(capacity=20)
    numbers = [add_episode(credit, episode) for episode in random_episodes([6] * 5)]
    assert [episode.step_ids.tolist() for episode in credit.store.episodes.values()] == numbers[2:]
    credit.fit()
    assert np.isfinite(credit.rewards_at(numbers[2:])).all()
    with pytest.raises(LareError, match=r"step 6 .*capacity = 20"):
        credit.rewards_at(numbers[1])
    (long,) = random_episodes([21])
    for add in (lambda: add_episode(credit, long), lambda: credit.add_episode(*long)):
        with pytest.raises(LareError, match=r"21 steps .*capacity"):
            add()


ROWS = {
    "observation": np.zeros((2, 2)),
    "action": np.zeros((2, 1)),
    "next_observation": np.zeros((2, 2)),
    "reward": np.zeros(2),
    "terminated": np.zeros(2),
    "truncated": np.zeros(2),
}


STEPS = {name: ROWS[name] for name in ("observation", "action", "next_observation")}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (ROWS | {"observation": np.zeros((2, 3))}, r"observation .*\(2, 3\).* 2 numbers"),
        (ROWS | {"observation": np.zeros(2)}, r"observation .*\(2,\).*\(steps, 2\)"),
        (ROWS | {"next_observation": np.zeros((2, 1))}, r"next_observation .*\(2, 1\).* 2 numbers"),
        (ROWS | {"reward": np.zeros((2, 1))}, r"reward .*\(2, 1\).* 2 steps"),
        (ROWS | {"terminated": np.zeros(3)}, r"terminated .*\(3,\).* 2 steps"),
        (ROWS | {"valid": [True]}, r"valid .*\(1,\).* 2 steps"),
        (ROWS | {"env_ids": [0, 1], "lanes": [0, 1]}, "env_ids and lanes"),
        (ROWS | {"alive": np.ones((2, 1))}, "single agent.* alive"),
        (ROWS | {"terminated": ["False", "False"]}, "terminated .*'False'.* numbers"),
        (ROWS | {"truncated": [np.nan, 0.5]}, "truncated .*true or false"),
        (ROWS | {"reward": [0, 1e16]}, r"reward\[1.*1e\+16"),
        (ROWS | {"observation": [[0, 0], [0, np.nan]]}, r"observation\[1, 1\] is nan"),
        (ROWS | {"observation": [[0, 0], [0, -1e16]]}, r"observation\[1, 1\] is -1.*at most 1e\+15"),
        (ROWS | {"next_observation": [[0, 0], [0, 1e300]]}, r"next_observation\[1.*inf"),
        (ROWS | {"reward": [0, -np.inf], "valid": [False, True]}, r"reward\[1.*-inf"),
        (STEPS | {"reward": np.nan}, "score is nan"),
        (STEPS | {"reward": [1e15, 1e15]}, "score is 2.*at most 1e\\+15"),
        (STEPS | {"reward": 1.0, "next_observation": np.full((2, 2), np.nan)}, r"next_observation\[0.*nan"),
        ({name: rows[:0] for name, rows in STEPS.items()} | {"reward": 1.0}, "no step"),
    ],
)
def test_add_and_add_episode_refuse(values, message):
    credit = small_assigner()
    with pytest.raises(LareError, match=message):
        (credit.add if "terminated" in values else credit.add_episode)(**values)
    assert credit.store.n_added == 0
    credit.add(**ROWS)
    # Steps need not follow each other.
    credit.add_episode(**STEPS | {"next_observation": np.ones((2, 2)), "reward": 1.0})
    assert (credit.store.n_ended, credit.store.dropped) == (1, 0)


NO_TASK = {"task": None, "observation_space": 2, "action_space": 1}


@pytest.mark.parametrize(
    ("method", "kind", "changes", "message"),
    [
        ("dense", None, {}, "assigns no credit"),
        ("arel", None, {"agents": 2, "max_steps": 5}, "lare_rl.train"),
        ("lare-rd", None, {}, "needs a phi"),
        ("diaster", None, {"agents": 2, "max_steps": 5}, "2 agents"),
        ("rd", None, {"agents": 2}, "max_steps"),
        ("ircr", None, {"scale_rewards": True}, "scale_rewards"),
        ("rd-linear", None, {"observation_space": 10_000}, "1024 .*10001"),
        ("rrdu", None, {"settings": CreditSettings(sampled_steps=8, batch_steps=4)}, r"steps = 4,.*sampled_steps = 8"),
        ("rd", None, {"action_space": None}, "action_space"),
        ("rd", None, {"task": TASK, "observation_space": 3}, "observation_space .*3 .*observation_size = 2"),
        ("rd", None, {"capacity": 0}, "capacity = 0"),
        ("rd", None, {"capacity": 10**20}, "capacity = 1000"),
        ("ircr", None, {"capacity": 10**15}, "capacity = 1000"),  # whose steps have no inputs
        ("rd", None, {"agents": 2, "max_steps": -3}, "max_steps = -3"),
        ("rd", None, {"fits_per_step": float("nan")}, "fits_per_step = nan"),
        ("rd", "factors", {}, "no phi"),
        ("lare-rd", "reward", {}, "'factors'.*'reward'"),
        ("lare-rd", "factors", NO_TASK, "task=task"),
        ("llm-reward", "reward", {"scored_observation": "both"}, "scored_observation"),
        ("lare-rd-shared", "factors", {}, "single agent"),
    ],
)
def test_init_refuses(method, kind, changes, message, phi, reward):
    function = {"factors": phi, "reward": reward, None: None}[kind]
    with pytest.raises(LareError, match=message):
        small_assigner(method, **({"phi": function} | changes))


def test_defaults(phi):
    assert CreditAssigner(phi=phi, task=TASK).config.method.name == "lare-bayes"
    assert CreditAssigner(observation_space=2, action_space=1).config.method.name == "bayes"
    assert CreditAssigner("bayes", task=pick_spec(score="average")).config.settings.score == "average"


def test_spaces_of_gymnasium_and_tasks():
    spaces = gymnasium.spaces
    observation_space = spaces.Dict(position=spaces.Box(-1, 1, (2,)), mode=spaces.Discrete(3))
    credit = CreditAssigner("rd", observation_space=observation_space, action_space=spaces.Discrete(4, start=1))
    observation = {"position": np.ones((2, 2)), "mode": np.array([0, 2])}
    credit.rewards_at(credit.add(observation, np.array([1, 4]), observation, [0, 0], [False] * 2, [False] * 2))
    rows = [[1, 1, 1, 0, 0], [1, 1, 0, 0, 1]]
    expected = np.hstack([rows, [[1, 0, 0, 0], [0, 0, 0, 1]], np.zeros((2, 5))])
    np.testing.assert_array_equal(credit.store.inputs[:2], expected)
    credit = CreditAssigner("bayes", task=pick_spec())
    steps = np.eye(4)[:2], np.array([3, 0]), np.eye(4)[1:3], [0, 0], [False] * 2, [False] * 2
    credit.rewards_at(credit.add(*steps))
    np.testing.assert_array_equal(credit.store.inputs[:2, 4:], np.eye(4)[[3, 0]])


@pytest.mark.parametrize("scored_observation", ["before", "after", "both"])
def test_scored_observation(scored_observation, phi):
    (episode,) = random_episodes([4])
    factors = small_assigner("lare-rd", phi, scored_observation=scored_observation)
    raw = small_assigner("bayes", scored_observation=scored_observation)
    changes = small_assigner("rd", scored_observation=scored_observation)
    for credit in (factors, raw, changes):
        credit.add_episode(*episode)
        credit.learner.flush_inputs()
    np.testing.assert_array_equal(factors.store.inputs[:4], phi.step_factors(*episode[:3], scored_observation))
    before, after = episode.observation, episode.next_observation
    observations = {"before": [before], "after": [after], "both": [before, after]}[scored_observation]
    expected = np.concatenate([*observations, episode.action], axis=1)
    np.testing.assert_array_equal(raw.store.inputs[:4], expected)
    expected = np.concatenate([before, episode.action, before - after], axis=1)
    np.testing.assert_array_equal(changes.store.inputs[:4], expected)


def team_episode(length, random, agents=3):
    """Return an episode of a team with the reward of each agent, and which agents are alive: one less from step to step."""
    episodes = [random_episode(length, random) for _ in range(agents)]
    episode = Episode(*(np.stack(arrays, axis=1) for arrays in zip(*episodes, strict=True)))
    return episode, np.arange(agents) < np.maximum(1, agents - np.arange(length))[:, None]


@pytest.mark.parametrize("method", cases([m for m in METHODS_FOR_STEPS if not m.single_agent_only], MANY_AGENT_KINDS))
def test_rewards_of_many_agents(method, function):
    credit = small_assigner(method, function, agents=3, max_steps=6)
    random, numbers, returns = np.random.default_rng(0), [], []
    for _ in range(12):
        episode, alive = team_episode(6, random)
        reward = np.where(alive, episode.reward, np.nan)
        numbers.append(credit.add_episode(*episode[:3], reward, alive=alive))
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
        np.testing.assert_allclose(
            credit.rewards(*episode[:3], begins=np.arange(len(episode[0])) == 0)[0], r_hat[-1, 0], rtol=1e-4, atol=1e-5
        )
        return
    credit.add_episode(*episode[:3], 5.0)  # a score of the team
    assert stored(credit)[-1] == (6, 5.0)
    assert credit.rewards_at([0, -1])[1].tolist() == [0, 0, 0]
    with pytest.raises(LareError, match=r"\(2, 2\).*\(steps, 3, 2\)"):
        credit.add(**ROWS)


SCORES = {
    "largest": lambda rows: rows[:, 0].max(),
    "smallest": lambda rows: rows[:, 1].min(),
    "sum": lambda rows: rows[:, 0].sum(),
}
"""Scores of the observations after the steps of an episode."""


@pytest.mark.long
@pytest.mark.parametrize("score", ["largest", "smallest", "sum"])
def test_must_learn_scores_that_are_no_sum(score):
    """The history predicts new scores, and is worse than sums nowhere. The steps that make the score get the rewards."""
    sums, history = small_assigner("bayes"), small_assigner("bayes-history")
    episodes = random_episodes([12] * 60)
    for credit in (sums, history):
        for episode in episodes:
            rows = credit.add_episode(*episode[:3], SCORES[score](episode.next_observation))
    r2 = [credit.metrics()["credit/return_r2"] for credit in (sums, history)]
    if score == "sum":
        assert min(r2) > 0.95
        return
    assert r2[1] > max(0.4, r2[0] + 0.2)
    r_hat = history.rewards_at(rows)
    begins = np.arange(len(rows)) == 0
    np.testing.assert_allclose(history.rewards(*episodes[-1][:3], begins=begins), r_hat, rtol=1e-4, atol=1e-5)
    with pytest.raises(LareError, match="begins"):
        history.rewards(*episodes[-1][:3])
    if score == "largest":
        levels = np.maximum.accumulate(episodes[-1].next_observation[:, 0])
        raises = np.append(True, np.diff(levels) > 0.05)
        assert r_hat[raises].mean() > r_hat[~raises].mean() + 0.02


@pytest.mark.long
def test_must_learn_the_value_of_events_in_order():
    """A door opens only after the key is found. Key and door are paid when they happen, and each episode gets its return."""
    rng, credit = np.random.default_rng(0), small_assigner("bayes-progress")
    rewards = {"key": [], "door": [], "other": []}
    for k in range(80):
        events = np.zeros((10, 2), np.float32)
        key, door = rng.integers(1, 10, 2)
        events[key:, 0], events[door:, 1] = 1, float(key < door)
        won = float(key < door and rng.random() < 0.8)
        before = np.concatenate([np.zeros((1, 2), np.float32), events[:-1]])
        r_hat = credit.rewards_at(credit.add_episode(before, np.zeros((10, 1), np.float32), events, won))
        np.testing.assert_allclose(r_hat.sum(), won if credit.learner.is_fitted else 0, atol=1e-4)
        if k > 40 and key < door < 9:
            rewards["key"].append(r_hat[key])
            rewards["door"].append(r_hat[door])
            rewards["other"] += np.delete(r_hat[:-1], [0, key, door]).tolist()
    key, door, other = (float(np.mean(values)) for values in rewards.values())
    assert door > 0.3
    assert key > 0.05
    assert abs(other) < 0.05


@pytest.mark.long
@pytest.mark.parametrize("method", ["bayes", "rd"])
def test_must_not_credit_steps_for_the_level(method, tmp_path):
    """Easy levels have larger returns and another state. With groups, the state gets no credit."""
    rng, names = np.random.default_rng(0), ("easy", "hard", "night")
    settings = SMALL_CREDIT.model_copy(update={"learning_rate": 0.01, "batch_steps": 100})
    grouped, blind = (small_assigner(method, groups=groups, settings=settings) for groups in (True, False))
    episodes = random_episodes([10] * 90)
    for i, episode in enumerate(episodes):
        level = i % 3
        shift = np.float32([0, 0.4 * (level - 1)])
        steps = episode.observation + shift, episode.action, episode.next_observation + shift
        score = episode.next_observation[:, 0].sum() + 20 * (1 - level) + 0.1 * rng.normal()
        grouped.add_episode(*steps, score, group=names[level])
        blind.add_episode(*steps, score)
    for credit in (grouped, blind):
        credit.fit(800)
    states, action = np.float32([[0, -0.5], [0, 0.5]]), np.zeros((2, 1), np.float32)
    credited = [abs(np.diff(credit.rewards(states, action, states))[0]) for credit in (grouped, blind)]
    assert credited[1] > 1.0
    assert credited[0] < 0.4 * credited[1]
    (sentence,) = (line for line in grouped.explanation() if "in group easy" in line)
    effects = {name: float(re.search(rf"([+-][\d.]+) in group {name}", sentence).group(1)) for name in names}
    assert effects["easy"] - effects["hard"] == pytest.approx(20, abs=4)
    assert effects["hard"] - effects["night"] == pytest.approx(20, abs=4)
    if method == "bayes":
        assert grouped.metrics()["credit/return_r2"] > 0.95
        grouped.save(tmp_path / "saved")
        loaded = CreditAssigner.load(tmp_path / "saved")
        assert loaded.group_names == {"easy": 0, "hard": 1, "night": 2}
        assert [e.level for e in loaded.store.episodes.values()] == [e.level for e in grouped.store.episodes.values()]
        np.testing.assert_array_equal(loaded.rewards(states, action, states), grouped.rewards(states, action, states))


def test_groups_that_do_not_fit_are_refused():
    episode = random_episode(5, np.random.default_rng(0))
    with pytest.raises(LareError, match="groups=True"):
        small_assigner().add_episode(*episode, group="easy")
    credit = small_assigner(groups=True)
    with pytest.raises(LareError, match="needs group"):
        credit.add_episode(*episode)
    with pytest.raises(LareError, match=r"2 entries.* 5 steps"):
        credit.add(*episode, np.zeros(5, bool), np.zeros(5, bool), group=["a", "b"])
    assert (credit.store.n_added, credit.learner.n_pending_steps) == (0, 0)
    is_valid = np.arange(5) == 0
    credit.add(*episode, is_valid, ~is_valid, valid=is_valid, group=["g0", "a", "b", "c", "d"])
    assert list(credit.group_names) == ["g0"]
    with pytest.raises(LareError, match="None when it is paid"):
        credit.add(*episode, is_valid, ~is_valid, valid=is_valid, group=[None, "a", "b", "c", "d"])
    for group, message in (
        ("abcde", "give a list"),
        ([("a", 1)] * 5, "a text or a number"),
        (["a", None, None, None, None], "None when it is paid"),
    ):
        with pytest.raises(LareError, match=message):
            credit.add(*episode, np.ones(5, bool), np.zeros(5, bool), group=group)
    assert list(credit.group_names) == ["g0"]
    for i in range(64):
        credit.add_episode(*episode, group=f"g{i}")
    with pytest.raises(LareError, match=r"more than 64 groups.*'new'"):
        credit.add_episode(*episode, group="new")


def test_signs_with_groups(chase):
    """Signs have no intercepts of groups."""
    phi = verify_function("def evaluation_func(o, a):\n    return [o[:, :1], o[:, 1:]]", chase)
    credit = small_assigner("lare-signs", phi, groups=True)
    for i, episode in enumerate(random_episodes([4, 5, 6])):
        credit.add_episode(*episode, group=str(i))
    credit.fit()
    assert set(np.abs(np.asarray(credit.learner.decoder.closed_form.decoder.weight)).ravel()) == {1}


@pytest.mark.parametrize("exact", ["last", "spread"])
def test_exact_needs_an_agent_at_every_step(exact):
    settings = SMALL_CREDIT.model_copy(update={"exact": exact})
    credit = small_assigner("rd-linear", agents=2, settings=settings)
    states, action, alive = np.zeros((3, 2, 2)), np.zeros((3, 2, 1)), np.ones((3, 2), bool)
    credit.add_episode(states, action, states, 1.0, alive=alive)
    alive[2] = False
    with pytest.raises(LareError, match="exact"):
        credit.add_episode(states, action, states, 1.0, alive=alive)


def test_end_needs_the_group_of_a_step():
    credit, (episode,) = small_assigner(groups=True), random_episodes([2])
    for env_id, groups in {"a": ["easy", None], "b": ["hard", None], "c": [None, None]}.items():
        for t, group in enumerate(groups):
            credit.add(*(array[[t]] for array in episode), [False], [False], env_ids=[env_id], group=[group])
    for env_id in "ab":
        credit.end(env_id, 1.0)
    assert [stored.level for stored in credit.store.episodes.values()] == [0, 1]
    with pytest.raises(LareError, match="'c' has no group"):
        credit.end("c", 1.0)
    assert list(credit.store.running) == ["c"]


@pytest.mark.long
def test_must_learn_what_wins():
    """Steps that raise the odds of a win get credit for it, and chances are predicted better than by a sum."""
    rng = np.random.default_rng(0)
    sums, odds = (
        small_assigner("bayes", settings=SMALL_CREDIT.model_copy(update={"score": s})) for s in ("sum", "binary")
    )
    for episode in random_episodes(rng.integers(5, 17, 300)):
        log_odds = 3 * episode.next_observation[:, 0].sum() - 2
        for credit in (sums, odds):
            rows = credit.add_episode(*episode[:3], float(rng.random() < 1 / (1 + np.exp(-log_odds))))
    gain = [credit.metrics()["credit/gain"] for credit in (sums, odds)]
    assert (sums.score_type, odds.score_type) == ("sum", "log odds")
    assert gain[1] > gain[0]
    assert gain[1] > 5 * odds.metrics()["credit/gain_error"]
    correlation = np.corrcoef(odds.rewards_at(rows), episode.next_observation[:, 0])[0, 1]
    assert correlation > 0.95
    assert any("log odds" in line for line in odds.explanation())
    assert [any("won or lost" in line for line in credit.explanation()) for credit in (sums, odds)] == [True, False]


def test_finished_episodes_are_learned_before_they_are_overwritten():
    credit = small_assigner(capacity=100, forget=False)
    add_episodes(credit, random_episodes([20] * 40))
    credit.fit(1)
    assert credit.learner.n_learned == 40


def test_residuals_of_pending_steps():
    """The first steps of an episode are asked for while its last ones have no inputs yet."""
    credit = small_assigner("bayes", settings=SMALL_CREDIT.model_copy(update={"exact": "spread"}))
    add_episodes(credit, random_episodes([10] * 30))
    credit.fit()
    step_ids = credit.add_episode(*random_episodes([10], seed=1)[0])
    first = credit.rewards_at(step_ids[:2])
    np.testing.assert_array_equal(credit.rewards_at(step_ids)[:2], first)
    assert credit.rewards_at(step_ids).sum() == pytest.approx(random_episodes([10], seed=1)[0].reward.sum(), rel=1e-4)


def test_single_row_of_a_box_with_an_axis_of_one():
    spaces = {"observation_space": Box(-1, 1, (1, 2), np.float32), "action_space": 1}
    credit = CreditAssigner("bayes", **spaces)
    rows = np.zeros((1, 2), np.float32)
    assert credit.add(rows, np.zeros((1, 1)), rows, [0.0], [True], [False]).shape == (1,)
