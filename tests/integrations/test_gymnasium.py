"""The assigner receives what a logging environment has logged, in every autoreset mode."""

import copy

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper
from gymnasium.wrappers import TimeLimit

from helpers.logged_envs import LoggedEnv, RandomEnv, RecordingAssigner, check_episodes, recording_assigner
from helpers.toy_envs import Levels, levels_spec, toy_spec
from lare_rl.envs.episodic import TRUE_REWARD
from lare_rl.errors import LareError
from lare_rl.integrations.gymnasium import Credit, VectorCredit
from lare_rl.integrations.recorder import CREDIT_STEP, check_assigner, check_pay
from lare_rl.tasks.payments import PaymentRule

SPACES = {
    "box": (None, None),
    "integers": (spaces.Box(0, 255, (2, 3), np.uint8), spaces.Discrete(3, start=1)),
    "discrete": (spaces.Discrete(5), spaces.Discrete(3)),
    "dict": (
        spaces.Dict(position=spaces.Box(-1, 1, (2,)), mode=spaces.Discrete(3), flags=spaces.MultiBinary(2)),
        spaces.MultiDiscrete([2, 3]),
    ),
    "tuple": (spaces.Tuple([spaces.Discrete(2), spaces.Box(-1, 1, (1, 2))]), spaces.Box(-1, 1, ())),
}
NEXT_STEP, SAME_STEP, DISABLED = AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED
all_modes = pytest.mark.parametrize("mode", AutoresetMode, ids=lambda mode: mode.name)


def make_vector(mode=NEXT_STEP, env_spaces=(None, None), copies=3):
    """Return a vector environment and its environments, which write each observation into the same memory."""
    # In SAME_STEP mode, Gymnasium keeps no copy of `final_obs` either.
    envs = [LoggedEnv(RandomEnv(*env_spaces, seed=seed, rewrites=mode != SAME_STEP)) for seed in range(copies)]
    return SyncVectorEnv([lambda env=env: env for env in envs], copy=False, autoreset_mode=mode), envs


def play(envs, n_steps, seed=0):
    """Play random steps, and reset environments that do not reset themselves. Return the results of `step`."""
    envs.action_space.seed(seed)
    envs.reset(seed=seed)
    results = []
    for _ in range(n_steps):
        results.append(copy.deepcopy(envs.step(envs.action_space.sample())))
        done = results[-1][2] | results[-1][3]
        if envs.metadata["autoreset_mode"] == DISABLED and done.any():
            envs.reset(options={"reset_mask": done})
    return results


def play_episodes(env, n_episodes):
    """Play episodes of random steps. Return the rewards and the `info` of each step."""
    results = []
    for _ in range(n_episodes):
        env.reset()
        done = False
        while not done:
            _, reward, terminated, truncated, info = env.step(env.action_space.sample())
            results.append((reward, info))
            done = terminated or truncated
    return results


@pytest.mark.parametrize("kind", SPACES)
def test_steps_of_spaces(kind):
    env = LoggedEnv(RandomEnv(*SPACES[kind], rewrites=True))
    credit = recording_assigner(env)
    results = play_episodes(Credit(env, credit, pay="environment"), 8)
    check_episodes(credit, [env])
    logged_rewards = [step[3] for step in env.all_steps()]
    assert [reward for reward, _ in results] == [info[TRUE_REWARD] for _, info in results] == logged_rewards
    assert [info[CREDIT_STEP] for _, info in results] == list(range(credit.store.n_added))
    vector, envs = make_vector(
        {"dict": SAME_STEP, "tuple": SAME_STEP, "discrete": DISABLED}.get(kind, NEXT_STEP), SPACES[kind]
    )
    vector_credit = recording_assigner(envs[0])
    play(VectorCredit(vector, vector_credit, pay="environment"), 40)
    check_episodes(vector_credit, envs)
    for assigner in (credit, vector_credit):
        assert assigner.store.dropped == assigner.n_fits == 0


def test_single_rewards_and_reset():
    """A reset drops the running episode, also if all observations are the same. Environments may share an assigner."""
    envs = [LoggedEnv(RandomEnv(spaces.Box(0, 0, (2,), np.float32), seed=seed)) for seed in range(2)]
    credit = recording_assigner(envs[0], "rd-linear")
    first, second = (Credit(env, credit) for env in envs)
    for wrapped in (first, second):
        wrapped.reset()
        wrapped.unwrapped.steps_left = 3
        wrapped.step(wrapped.action_space.sample())
    play_episodes(second, 4)
    results = play_episodes(first, 12)
    check_episodes(credit, envs)
    assert (credit.store.dropped, credit.n_fits) == (2, credit.store.n_added)
    assert results[-1][0] == pytest.approx(float(credit.rewards_at([credit.store.n_added - 1])[0])) != 0


@all_modes
def test_vector_rewards(mode):
    """r_hat is returned, and `infos` has the rewards and step numbers. A row that resets is no step."""
    plain = play(make_vector(mode)[0], 40)
    vector, envs = make_vector(mode)
    credit = recording_assigner(envs[0], "rd-linear")
    results = play(VectorCredit(vector, credit), 40)
    check_episodes(credit, envs)
    for (_, r_hat, *_, infos), (_, reward, *_) in zip(results, plain, strict=True):
        steps = infos[CREDIT_STEP]
        np.testing.assert_array_equal(infos[TRUE_REWARD], reward)
        for name in (TRUE_REWARD, CREDIT_STEP):
            np.testing.assert_array_equal(infos[f"_{name}"], steps >= 0)
        assert (r_hat[steps < 0] == 0).all()
        assert r_hat.dtype == reward.dtype
    numbers = np.concatenate([infos[CREDIT_STEP] for *_, infos in results])
    assert (numbers < 0).any() == (mode == NEXT_STEP)
    assert sorted(numbers[numbers >= 0].tolist()) == list(range(credit.store.n_added))
    assert (credit.n_fits, credit.store.dropped) == (40, 0)
    assert credit.store.n_added == sum(len(env.all_steps()) for env in envs)
    assert (results[0][1] == 0).all()  # before the first fit
    assert results[-1][1].any()
    np.testing.assert_allclose(results[-1][1], credit.rewards_at(results[-1][-1][CREDIT_STEP]), rtol=1e-6)


@all_modes
def test_vector_reset_drops_episodes(mode):
    """In NEXT_STEP mode, the call after an end resets, unless the loop has done it."""
    vector, envs = make_vector(mode)
    credit = recording_assigner(envs[0])
    wrapped = VectorCredit(vector, credit, pay="environment")
    play(wrapped, 10)
    n_running = sum(bool(env.steps) for env in envs)
    wrapped.reset()
    for env in envs:
        env.unwrapped.steps_left = 1
    wrapped.step(wrapped.action_space.sample())
    play(wrapped, 10)
    check_episodes(credit, envs)
    assert credit.store.dropped == n_running > 0


def test_reset_mask_drops_one_episode():
    vector, envs = make_vector(DISABLED)
    credit = recording_assigner(envs[0])
    wrapped = VectorCredit(vector, credit, pay="environment")
    wrapped.reset()
    actions = wrapped.action_space.sample()
    for env in envs:
        env.unwrapped.steps_left = 4
    wrapped.step(actions)
    wrapped.reset(options={"reset_mask": np.array([False, True, False])})
    envs[1].unwrapped.steps_left = 4
    for _ in range(3):
        wrapped.step(actions)
    check_episodes(credit, envs)
    assert (len(credit.store.episodes), credit.store.dropped) == (2, 1)


@all_modes
def test_score_in_info(mode):
    vector, envs = make_vector(mode)
    credit = recording_assigner(envs[0])
    play(VectorCredit(vector, credit, pay="environment", score="score"), 40)
    check_episodes(credit, envs, use_score=True)
    env = LoggedEnv(RandomEnv())
    credit = recording_assigner(env)
    play_episodes(Credit(env, credit, score="score"), 3)
    check_episodes(credit, [env], use_score=True)
    with pytest.raises(LareError, match="'goals'"):
        play(VectorCredit(make_vector(mode)[0], recording_assigner(env), score="goals"), 40)


class Ended(gymnasium.Wrapper):
    """Notes the levels of the episodes that have ended, in their order."""

    def __init__(self, env, levels):
        super().__init__(env)
        self.levels = levels

    def step(self, action):
        *results, info = self.env.step(action)
        if results[2] or results[3]:
            self.levels.append(info["level"])
        return *results, info


@pytest.mark.parametrize(("mode", "payments"), [*((mode, "end") for mode in AutoresetMode), (NEXT_STEP, 2)])
def test_groups_are_read_from_info(mode, payments):
    levels, credit = [], RecordingAssigner("bayes", task=levels_spec(payments=payments))
    vector = SyncVectorEnv([lambda n=n: Ended(TimeLimit(Levels(), n), levels) for n in (3, 4)], autoreset_mode=mode)
    play(VectorCredit(vector, credit, pay="environment"), 20)
    names, episodes = list(credit.group_names), list(credit.store.episodes.values())
    assert len(set(levels)) > 1
    if payments == "end":
        assert [names[episode.level] for episode in episodes] == levels
    assert set(levels) <= set(names)
    assert {type(name) for name in names} == {int}


def test_task_without_spaces():
    """The assigner only has the sizes of the rows, and the environment says how to make them."""
    observation_space = spaces.Dict(target=spaces.Box(-1, 1, (1,)), noise=spaces.Box(-1, 1, (1,)))
    vector, envs = make_vector(env_spaces=(observation_space, spaces.Box(-1, 1, (1, 1))))
    credit = RecordingAssigner("ircr", task=toy_spec())
    play(VectorCredit(vector, credit), 20)
    check_episodes(credit, envs)


class WholeRewards(VectorWrapper):
    """Has rewards that are whole numbers, and an info that is the same for all environments."""

    def step(self, actions):
        observation, reward, *flags, infos = self.env.step(actions)
        return (
            observation,
            reward.astype(int),
            *flags,
            infos | {"time": 0.1, "log": np.zeros(0), "names": [[1], [2, 3]]},
        )


def test_whole_rewards_and_infos_of_all_environments():
    vector, envs = make_vector()
    results = play(VectorCredit(WholeRewards(vector), recording_assigner(envs[0]), score="score"), 9)
    assert 0.5 in results[0][1]  # what ircr pays before an episode ends


class WithoutFinalObs(VectorWrapper):
    def step(self, actions):
        *results, infos = self.env.step(actions)
        return *results, {name: value for name, value in infos.items() if name != "final_obs"}


def play_once(env, action):
    env.reset()
    env.step(action)


def small_assigner(**changes):
    return RecordingAssigner("ircr", **({"observation_space": 2, "action_space": 1} | changes))


@pytest.mark.parametrize(
    ("wrap", "message"),
    [
        (lambda: check_assigner("bayes"), "CreditAssigner.*'bayes'"),
        (lambda: Credit(RandomEnv(), small_assigner(agents=2, max_steps=5)), "agents=2.* has 1"),
        (lambda: check_pay("all"), "pay = 'all'"),
        (
            lambda: Credit(RandomEnv(), small_assigner(payments=PaymentRule(period=2)), score="s"),
            "'s' is the score of an",
        ),
        (lambda: play_once(Credit(RandomEnv(), small_assigner()), "right"), "the action is 'right'"),
        (lambda: Credit(RandomEnv(), small_assigner(observation_space=3)), "observations .* 2 numbers.* 3"),
        (lambda: VectorCredit(make_vector()[0], small_assigner(action_space=4)), "actions .* 1 numbers.* 4"),
        (
            lambda: VectorCredit(type("Silent", (VectorEnv,), {"metadata": {}})(), small_assigner()),
            "autoreset_mode.* = None",
        ),
        (
            lambda: play(VectorCredit(WithoutFinalObs(make_vector(SAME_STEP)[0]), small_assigner()), 9),
            "SAME_STEP.* no final_obs",
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
def test_checker_of_gymnasium():
    env = gymnasium.make("Pendulum-v1")
    wrapped = Credit(env, recording_assigner(env), score="score")
    assert gymnasium.make(wrapped.spec).score == "score"
    check_env(WithoutStepNumber(Credit(env, recording_assigner(env))), skip_render_check=True)
    wrapped.close()
