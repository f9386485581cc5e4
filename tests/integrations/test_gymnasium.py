"""The assigner is shown what a logging environment has logged, in every autoreset mode."""

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

from helpers.assigner_episodes import SMALL_CREDIT, LoggedEnv, check_stored_episodes, small_assigner
from helpers.toy_envs import toy_spec
from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.envs.episodic import TRUE_REWARD, EpisodicReward
from lare_rl.errors import LareError
from lare_rl.integrations.gymnasium import Credit, VectorCredit
from lare_rl.integrations.recorder import CREDIT_STEP, check_assigner, check_pay

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
all_modes = pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
all_spaces = pytest.mark.parametrize("env_spaces", SPACES.values(), ids=SPACES)


def make_assigner(env):
    return CreditAssigner(
        "rd",
        observation_space=env.observation_space,
        action_space=env.action_space,
        settings=SMALL_CREDIT,
        capacity=1000,
    )


def make_vector(mode=AutoresetMode.NEXT_STEP, env_spaces=(None, None), copies=3):
    """Return a vector environment and its environments, which write each observation into the same memory."""
    # In SAME_STEP mode, Gymnasium keeps no copy of `final_obs` either.
    rewrites = mode != AutoresetMode.SAME_STEP
    envs = [LoggedEnv(*copy.deepcopy(env_spaces), seed=seed, rewrites=rewrites) for seed in range(copies)]
    return SyncVectorEnv([lambda env=env: env for env in envs], copy=False, autoreset_mode=mode), envs


def play(envs, n_steps, seed=0):
    """Play random steps, and reset environments that do not reset themselves. Return the results of `step`."""
    envs.action_space.seed(seed)
    envs.reset(seed=seed)
    results = []
    for _ in range(n_steps):
        results.append(copy.deepcopy(envs.step(envs.action_space.sample())))
        done = results[-1][2] | results[-1][3]
        if envs.metadata["autoreset_mode"] == AutoresetMode.DISABLED and done.any():
            envs.reset(options={"reset_mask": done})
    return results


def play_episodes(env, n_episodes):
    for _ in range(n_episodes):
        env.reset()
        while not any(env.step(env.action_space.sample())[2:4]):
            pass


@all_spaces
@all_modes
def test_vector_steps(mode, env_spaces):
    vector, envs = make_vector(mode, env_spaces)
    credit = make_assigner(envs[0])
    play(VectorCredit(vector, credit, pay="environment"), 40)
    check_stored_episodes(credit, envs)
    assert credit.store.dropped == 0
    n_finished = sum(len(steps) for env in envs for steps, _ in env.episodes)
    assert credit.store.steps == n_finished + sum(len(env.running) for env in envs if env.n_remaining > 0)


@all_spaces
def test_single_steps(env_spaces):
    env = LoggedEnv(*copy.deepcopy(env_spaces), rewrites=True)
    credit = make_assigner(env)
    wrapped = Credit(env, credit, pay="environment")
    for _ in range(8):
        wrapped.reset()
        done = False
        while not done:
            _, reward, terminated, truncated, info = wrapped.step(env.action_space.sample())
            assert reward == info[TRUE_REWARD] == env.running[-1][3]
            done = terminated or truncated
        assert info[CREDIT_STEP] == credit.store.steps - 1
    check_stored_episodes(credit, [env])
    assert credit.store.dropped == 0


@all_modes
def test_vector_rewards(mode):
    """r_hat is returned, and `infos` has the rewards and step numbers. A row that resets is no step."""
    plain = play(make_vector(mode)[0], 40)
    credit = small_assigner("rd-linear")
    results = play(VectorCredit(make_vector(mode)[0], credit), 40)
    for (_, r_hat, *_, infos), (_, reward, *_) in zip(results, plain, strict=True):
        steps = infos[CREDIT_STEP]
        np.testing.assert_array_equal(infos[TRUE_REWARD], reward)
        np.testing.assert_array_equal(infos[f"_{CREDIT_STEP}"], steps >= 0)
        assert (r_hat[steps < 0] == 0).all()
        assert r_hat.dtype == reward.dtype
    numbers = np.concatenate([infos[CREDIT_STEP] for *_, infos in results])
    assert (numbers < 0).any() == (mode == AutoresetMode.NEXT_STEP)
    assert sorted(numbers[numbers >= 0].tolist()) == list(range(credit.store.steps))
    assert (results[0][1] == 0).all()  # before the first fit
    np.testing.assert_allclose(results[-1][1], credit.rewards_at(results[-1][-1][CREDIT_STEP]), rtol=1e-6)


def test_gradient_updates():
    """They are made as steps come in, unless the loop trains on the environment's rewards."""
    n_updates = {}
    for pay in ("proxy", "environment"):
        credit = small_assigner("rrdu")
        play(VectorCredit(make_vector()[0], credit, pay=pay), 40)
        n_updates[pay] = credit.metrics()["credit/fits"]
    assert 0 < n_updates["proxy"] <= credit.store.steps
    assert n_updates["environment"] == 0


@all_modes
def test_vector_reset_drops_episodes(mode):
    vector, envs = make_vector(mode)
    credit = small_assigner("rd")
    wrapped = VectorCredit(vector, credit, pay="environment")
    play(wrapped, 10)
    n_running = sum(env.n_remaining > 0 and bool(env.running) for env in envs)
    play(wrapped, 10)
    check_stored_episodes(credit, envs)
    assert credit.store.dropped == n_running > 0


def test_reset_mask_drops_one_episode():
    vector, envs = make_vector(AutoresetMode.DISABLED)
    credit = small_assigner("rd")
    wrapped = VectorCredit(vector, credit, pay="environment")
    for env in envs:
        env.reset = lambda env=env, **_: (LoggedEnv.reset(env), setattr(env, "n_remaining", 4))[0]
    wrapped.reset()
    actions = wrapped.action_space.sample()
    wrapped.step(actions)
    wrapped.reset(options={"reset_mask": np.array([False, True, False])})
    for _ in range(3):
        wrapped.step(actions)
    check_stored_episodes(credit, envs)
    assert (len(credit.store.episodes), credit.store.dropped) == (2, 1)


def test_single_reset_drops_episode():
    """Also if all observations are the same."""
    env = LoggedEnv(spaces.Discrete(1), None)
    credit = make_assigner(env)
    wrapped = Credit(env, credit)
    wrapped.reset()
    env.n_remaining = 3
    wrapped.step(env.action_space.sample())
    wrapped.reset()
    env.n_remaining = 2
    for _ in range(2):
        wrapped.step(env.action_space.sample())
    check_stored_episodes(credit, [env])
    assert credit.store.dropped == 1


@all_modes
def test_score_in_info(mode):
    vector, envs = make_vector(mode)
    credit = small_assigner("rd")
    play(VectorCredit(vector, credit, pay="environment", score="score"), 40)
    check_stored_episodes(credit, envs, by="score")
    env = LoggedEnv()
    credit = make_assigner(env)
    play_episodes(Credit(env, credit, score="score"), 3)
    check_stored_episodes(credit, [env], by="score")
    with pytest.raises(LareError, match="'goals'"):
        play(VectorCredit(make_vector(mode)[0], small_assigner("rd"), score="goals"), 40)


def test_shared_assigner():
    envs = [LoggedEnv(seed=seed) for seed in range(3)]
    credit = make_assigner(envs[0])
    play(SyncVectorEnv([lambda env=env: Credit(env, credit) for env in envs]), 30)
    check_stored_episodes(credit, envs)
    assert credit.store.dropped == 0


def test_other_wrappers():
    """Statistics inside see the environment's rewards, statistics outside r_hat."""
    vector, envs = make_vector()
    inside = RecordEpisodeStatistics(vector)
    outside = RecordEpisodeStatistics(VectorCredit(inside, small_assigner("rd-linear")), stats_key="r_hat")
    play(outside, 40)
    returns = [sum(step[3] for step in steps) for env in envs for steps, _ in env.episodes]
    assert sorted(inside.return_queue) == pytest.approx(sorted(returns), abs=1e-5)
    assert outside.return_queue != inside.return_queue
    play_episodes(NormalizeObservation(Credit(TimeLimit(LoggedEnv(), 3), small_assigner("rd"))), 1)


@all_modes
def test_rewards_replaced_by_inner_wrapper(mode):
    """`infos` still has the environment's own rewards."""
    envs = [LoggedEnv(seed=3 + seed) for seed in range(2)]
    vector = SyncVectorEnv([lambda env=env: EpisodicReward(env) for env in envs], autoreset_mode=mode)
    for *_, infos in play(VectorCredit(vector, make_assigner(envs[0])), 20):
        mask = infos[f"_{TRUE_REWARD}"]
        rewards = {step[3] for env in envs for steps, _ in [*env.episodes, (env.running, 0)] for step in steps}
        assert set(infos[TRUE_REWARD][mask].tolist()) <= rewards


def test_task_without_spaces(phi):
    """The assigner only has the sizes of the rows, and the environment says how to make them."""
    observation_space = spaces.Dict(target=spaces.Box(-1, 1, (1,)), noise=spaces.Box(-1, 1, (1,)))
    vector, envs = make_vector(env_spaces=(observation_space, spaces.Box(-1, 1, (1, 1))))
    credit = CreditAssigner("lare-linear", phi, task=toy_spec(), capacity=100)
    play(VectorCredit(vector, credit), 20)
    credit.metrics()  # computes all features
    for steps, _ in (episode for env in envs for episode in env.episodes):
        observation = np.float32([spaces.flatten(observation_space, step[0]) for step in steps])
        action = np.float32([step[1].ravel() for step in steps])
        return_ = sum(step[3] for step in steps)
        (episode,) = (episode for episode in credit.store.episodes.values() if episode.score == return_)
        np.testing.assert_array_equal(credit.store.features[episode.steps], phi(observation, action))


@pytest.mark.parametrize(
    ("wrap", "message"),
    [
        (lambda: check_assigner("bayes"), "must be a CreditAssigner, and is 'bayes'"),
        (lambda: Credit(LoggedEnv(), small_assigner("rd", agents=2, max_steps=5)), "agents=2.* has 1"),
        (lambda: check_pay("all"), "pay = 'all'"),
        (lambda: Credit(LoggedEnv(), small_assigner("rd", observation_space=3)), "observations .* 2 numbers.* 3"),
        (lambda: VectorCredit(make_vector()[0], small_assigner("rd", action_space=4)), "actions .* 1 numbers.* 4"),
        (
            lambda: VectorCredit(type("Silent", (VectorEnv,), {"metadata": {}})(), small_assigner("rd")),
            "autoreset_mode.* = None",
        ),
    ],
)
def test_bad_arguments(wrap, message):
    with pytest.raises(LareError, match=message):
        wrap()


class WithoutStepNumber(gymnasium.Wrapper, RecordConstructorArgs):
    """Gymnasium's checker wants the same `info` twice, and each step has another number."""

    def __init__(self, env):
        RecordConstructorArgs.__init__(self)
        gymnasium.Wrapper.__init__(self, env)

    def step(self, action):
        *results, info = self.env.step(action)
        return *results, {name: value for name, value in info.items() if name != CREDIT_STEP}


@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version:UserWarning")
@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space:UserWarning")
@pytest.mark.parametrize("pay", ["proxy", "environment"])
def test_checker_of_gymnasium(pay):
    env = gymnasium.make("Pendulum-v1")
    wrapped = WithoutStepNumber(Credit(env, make_assigner(env), pay))
    check_env(wrapped, skip_render_check=True)
    wrapped.close()


def test_make_from_spec():
    env = gymnasium.make("Pendulum-v1")
    again = gymnasium.make(Credit(env, make_assigner(env), score="score").spec)
    assert isinstance(again, Credit)
    assert again.score == "score"
