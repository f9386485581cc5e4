"""What the assigner is shown equals a log that the environment keeps, whichever way it is reset."""

import copy

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers import NormalizeObservation, TimeLimit
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from helpers.shown import SMALL, Logged, assigner, check_episodes
from helpers.toys import toy_spec
from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.envs.episodic import TRUE_REWARD, EpisodicReward
from lare_rl.errors import LareError
from lare_rl.integrations.gymnasium import CREDIT_STEP, Credit, VectorCredit, check_pay

SPACES = {
    "box": (None, None),
    "integers": (spaces.Box(0, 255, (2, 3), np.uint8), spaces.Discrete(3, start=1)),
    "discrete": (spaces.Discrete(5), spaces.Discrete(3)),
    "dict": (
        spaces.Dict(place=spaces.Box(-1, 1, (2,)), mode=spaces.Discrete(3), flags=spaces.MultiBinary(2)),
        spaces.MultiDiscrete([2, 3]),
    ),
    "tuple": (spaces.Tuple([spaces.Discrete(2), spaces.Box(-1, 1, (1, 2))]), spaces.Dict(a=spaces.Box(-1, 1, ()))),
}
MODES = list(AutoresetMode)


def credit_for(environment, **changes):
    return CreditAssigner(
        "rd",
        observation_space=environment.observation_space,
        action_space=environment.action_space,
        settings=SMALL,
        capacity=1000,
        **changes,
    )


def vector(mode=AutoresetMode.NEXT_STEP, own=(None, None), copies=3, shared=True):
    """A vector environment and the environments in it."""
    # Where it resets in the same step, Gymnasium keeps no copy of `final_obs` either.
    rewrites = shared and mode != AutoresetMode.SAME_STEP
    logged = [Logged(*copy.deepcopy(own), seed=seed, rewrites=rewrites) for seed in range(copies)]
    makers = [lambda one=one: one for one in logged]
    return SyncVectorEnv(makers, copy=not shared, autoreset_mode=mode), logged


def play(envs, steps, seed=0):
    """Random steps; the loop resets where the environments do not. What each call gave."""
    envs.action_space.seed(seed)
    envs.reset(seed=seed)
    found = []
    for _ in range(steps):
        found.append(copy.deepcopy(envs.step(envs.action_space.sample())))
        ended = found[-1][2] | found[-1][3]
        if envs.metadata["autoreset_mode"] == AutoresetMode.DISABLED and ended.any():
            envs.reset(options={"reset_mask": ended})
    return found


@pytest.mark.parametrize("own", SPACES.values(), ids=SPACES)
@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
def test_an_assigner_is_shown_what_happens(mode, own):
    envs, logged = vector(mode, own)
    credit = credit_for(logged[0])
    play(VectorCredit(envs, credit, pay="environment"), 40)
    check_episodes(credit, logged)
    assert credit.store.dropped == 0
    assert credit.store.steps == sum(len(steps) for one in logged for steps, _ in one.episodes) + sum(
        len(one.going) for one in logged if one.left > 0
    )


@pytest.mark.parametrize("own", SPACES.values(), ids=SPACES)
def test_a_single_environment_is_shown_too(own):
    environment = Logged(*copy.deepcopy(own), rewrites=True)
    credit = credit_for(environment)
    wrapped = Credit(environment, credit, pay="environment")
    for _ in range(8):
        wrapped.reset()
        over = False
        while not over:
            _, reward, terminated, truncated, info = wrapped.step(environment.action_space.sample())
            assert reward == info[TRUE_REWARD] == environment.going[-1][3]
            over = terminated or truncated
        assert info[CREDIT_STEP] == credit.store.steps - 1
    check_episodes(credit, [environment])
    assert credit.store.dropped == 0


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
def test_what_is_paid_and_what_is_kept(mode):
    """r_hat by the newest decoder, and rewards and numbers beside it; a row that resets is no step."""
    envs, _ = vector(mode)
    plain = play(vector(mode)[0], 40)
    credit = assigner("rd-linear")
    found = play(VectorCredit(envs, credit), 40)
    resets, paid = 0, []
    for (_, r_hat, *_, infos), (_, reward, *_) in zip(found, plain, strict=True):
        steps = infos[CREDIT_STEP]
        np.testing.assert_array_equal(infos[TRUE_REWARD], reward)
        np.testing.assert_array_equal(infos[f"_{CREDIT_STEP}"], steps >= 0)
        assert (r_hat[steps < 0] == 0).all()
        resets += int((steps < 0).sum())
        paid.append(r_hat)
        assert r_hat.dtype == reward.dtype
    assert (resets > 0) == (mode == AutoresetMode.NEXT_STEP)
    assert (paid[0] == 0).all()  # nothing is known yet
    np.testing.assert_allclose(paid[-1], credit.rewards_at(found[-1][-1][CREDIT_STEP]), rtol=1e-6)
    numbers = np.concatenate([step[-1][CREDIT_STEP] for step in found])
    assert sorted(numbers[numbers >= 0].tolist()) == list(range(credit.store.steps))


def test_a_network_is_fitted_as_steps_come_in():
    credit = assigner("rrdu")
    play(VectorCredit(vector()[0], credit), 40)
    assert 0 < credit.learner.fits <= credit.store.steps
    watched = assigner("rrdu")
    play(VectorCredit(vector()[0], watched, pay="environment"), 40)
    assert watched.learner.fits == 0


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
def test_a_reset_in_the_middle_gives_episodes_up(mode):
    envs, logged = vector(mode)
    credit = assigner("rd")
    wrapped = VectorCredit(envs, credit, pay="environment")
    play(wrapped, 10)
    going = sum(one.left > 0 and bool(one.going) for one in logged)
    play(wrapped, 10)
    check_episodes(credit, logged)
    assert credit.store.dropped == going > 0


def test_a_part_can_be_reset_in_the_middle():
    envs, logged = vector(AutoresetMode.DISABLED)
    credit = assigner("rd")
    wrapped = VectorCredit(envs, credit, pay="environment")
    for one in logged:
        one.reset = lambda one=one, **_: (Logged.reset(one), setattr(one, "left", 4))[0]
    wrapped.reset()
    actions = wrapped.action_space.sample()
    wrapped.step(actions)
    wrapped.reset(options={"reset_mask": np.array([False, True, False])})
    for _ in range(3):
        wrapped.step(actions)
    check_episodes(credit, logged)
    assert len(credit.store.episodes) == 2
    assert credit.store.dropped == 1


def test_a_single_reset_in_the_middle_gives_the_episode_up():
    """Though the first observation is always the same, and here the last one too."""
    environment = Logged(spaces.Discrete(1), None)
    credit = credit_for(environment)
    wrapped = Credit(environment, credit)
    wrapped.reset()
    environment.left = 3
    wrapped.step(environment.action_space.sample())
    wrapped.reset()
    environment.left = 2
    for _ in range(2):
        wrapped.step(environment.action_space.sample())
    check_episodes(credit, [environment])
    assert credit.store.dropped == 1


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
def test_a_score_may_stand_in_info(mode):
    envs, logged = vector(mode)
    credit = assigner("rd")
    play(VectorCredit(envs, credit, pay="environment", score="score"), 40)
    check_episodes(credit, logged, by="score")


def test_a_score_may_stand_in_the_info_of_one():
    environment = Logged()
    credit = credit_for(environment)
    wrapped = Credit(environment, credit, score="score")
    for _ in range(3):
        wrapped.reset()
        while not any(wrapped.step(environment.action_space.sample())[2:4]):
            pass
    check_episodes(credit, [environment], by="score")


def test_a_time_limit_ends_episodes():
    environment = gymnasium.make("toys/Chase-v0")
    credit = assigner("rd")
    wrapped = Credit(environment, credit, pay="environment")
    wrapped.reset(seed=0)
    total, truncated = 0.0, False
    while not truncated:
        _, reward, _, truncated, _ = wrapped.step(environment.action_space.sample())
        total += reward
    (kept,) = credit.store.episodes.values()
    assert (len(kept.steps), kept.score) == (20, total)


def test_several_environments_may_share_an_assigner():
    logged = [Logged(seed=seed) for seed in range(3)]
    credit = credit_for(logged[0])
    envs = SyncVectorEnv([lambda one=one: Credit(one, credit) for one in logged])
    play(envs, 30)
    check_episodes(credit, logged)
    assert credit.store.dropped == 0


def test_other_wrappers_go_around_it():
    """Statistics inside see what the environment pays; those outside what the assigner says."""
    envs, logged = vector(AutoresetMode.NEXT_STEP)
    credit = assigner("rd-linear")
    inside = RecordEpisodeStatistics(envs)
    outside = RecordEpisodeStatistics(VectorCredit(inside, credit), stats_key="r_hat")
    play(outside, 40)
    totals = [sum(step[3] for step in steps) for one in logged for steps, _ in one.episodes]
    assert sorted(inside.return_queue) == pytest.approx(sorted(totals), abs=1e-5)
    assert outside.return_queue != inside.return_queue
    one = Logged()
    wrapped = NormalizeObservation(Credit(TimeLimit(one, 3), assigner("rd")))
    wrapped.reset()
    wrapped.step(one.action_space.sample())


def test_rewards_that_were_replaced_inside_stay_known():
    logged = [Logged(seed=seed) for seed in range(2)]
    credit = credit_for(logged[0])
    for mode in MODES:
        makers = [lambda one=one: EpisodicReward(one) for one in logged]
        envs = VectorCredit(SyncVectorEnv(makers, autoreset_mode=mode), credit)
        for one in logged:
            one.__init__(seed=3)
        for *_, infos in play(envs, 20):
            there = infos[f"_{TRUE_REWARD}"]
            known = {step[3] for one in logged for steps, _ in one.episodes for step in steps}
            known |= {step[3] for one in logged for step in one.going}
            assert set(infos[TRUE_REWARD][there].tolist()) <= known


def test_a_task_without_spaces_is_enough(phi):
    """It says how many numbers there are; the environment says how they lie."""
    parts = spaces.Dict(target=spaces.Box(-1, 1, (1,)), noise=spaces.Box(-1, 1, (1,)))
    envs, logged = vector(own=(parts, spaces.Box(-1, 1, (1, 1))))
    credit = CreditAssigner("lare-linear", phi, task=toy_spec(), capacity=100)
    play(VectorCredit(envs, credit), 20)
    credit.look()
    for one in logged:
        for steps, _ in one.episodes:
            rows = np.float32([spaces.flatten(parts, step[0]) for step in steps])
            action = np.float32([step[1].ravel() for step in steps])
            total = sum(step[3] for step in steps)
            (kept,) = (kept for kept in credit.store.episodes.values() if kept.score == total)
            np.testing.assert_array_equal(credit.store.features[kept.steps], phi(rows, action))


def test_what_does_not_fit_is_refused(phi):
    environment, credit = Logged(), assigner("rd")
    (envs, _), many = vector(), assigner("rd", agents=2, max_steps=5)
    silent = type("Silent", (VectorEnv,), {"metadata": {}})()
    cases = [
        (lambda: Credit(environment, many), "Gymnasium environments have one agent, and the assigner has agents = 2"),
        (lambda: check_pay("all"), "pay = 'all': it is 'proxy' or 'environment'"),
        (
            lambda: Credit(environment, assigner("rd", observation_space=3)),
            "observations of the environment are rows of 2 numbers, and the assigner was made for 3",
        ),
        (
            lambda: VectorCredit(envs, assigner("rd", action_space=4)),
            "actions of the environment are rows of 1 numbers, and the assigner was made for 4",
        ),
        (
            lambda: VectorCredit(silent, credit),
            'the vector environment does not say when it resets: metadata["autoreset_mode"] must be an AutoresetMode, '
            "and is None",
        ),
        (
            lambda: play(VectorCredit(envs, credit, score="goals"), 40),
            "the info of the last step has no 'goals': it has 'score'",
        ),
    ]
    for make, message in cases:
        with pytest.raises(LareError) as refused:
            make()
        assert str(refused.value) == message


class WithoutNumber(gymnasium.Wrapper, RecordConstructorArgs):
    """The checker wants the same `info` twice, and no step has the number of another."""

    def __init__(self, env):
        RecordConstructorArgs.__init__(self)
        gymnasium.Wrapper.__init__(self, env)

    def step(self, action):
        *rest, info = self.env.step(action)
        return *rest, {name: value for name, value in info.items() if name != CREDIT_STEP}


@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version:UserWarning")
@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space:UserWarning")
@pytest.mark.parametrize("pay", ["proxy", "environment"])
def test_gymnasiums_checker_finds_no_fault(pay):
    environment = gymnasium.make("Pendulum-v1")
    wrapped = WithoutNumber(Credit(environment, credit_for(environment), pay))
    check_env(wrapped, skip_render_check=True)
    wrapped.close()


def test_it_can_be_made_again_from_its_spec():
    environment = gymnasium.make("Pendulum-v1")
    wrapped = Credit(environment, credit_for(environment), score="score")
    again = gymnasium.make(wrapped.spec)
    assert isinstance(again, Credit)
    assert again.score == "score"
