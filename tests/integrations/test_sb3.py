"""Replay buffers and callback, in the algorithms of Stable-Baselines3 and sb3-contrib."""

import numpy as np
import pytest
import sb3_contrib
import torch
from gymnasium.spaces import Box, Dict, Discrete
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import A2C, DQN, PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback, EveryNTimesteps
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from helpers.assigner_episodes import SMALL_CREDIT
from helpers.logged_envs import LoggedEnv, RecordingAssigner, check_episodes
from helpers.long_tests import long_case
from helpers.toy_envs import Chase, Levels, Pick, levels_spec
from lare_rl import CreditAssigner, EpisodicReward, LareError
from lare_rl.integrations.sb3 import CreditCallback, CreditDictReplayBuffer, CreditNStepReplayBuffer, CreditReplayBuffer

SMALL_BUFFER = {"learning_starts": 30, "buffer_size": 300, "batch_size": 8, "train_freq": 1, "gradient_steps": 1}
EPISODE_STEPS = 20


class DictChase(Chase):
    observation_space = Dict({"place": Box(-1, 1, (2,), np.float32), "side": Discrete(2)})

    def observe(self):
        state = super().observe()
        return {"place": state, "side": int(state[0] > 0)}


class ConstantChase(Chase):
    """A reset cannot be seen in the observations."""

    def observe(self):
        self.state = np.zeros(2, np.float32)
        return self.state


class MaskedPick(Pick):
    def action_masks(self):
        return np.ones(4, bool)


def make_env(env_class=Chase):
    return LoggedEnv(TimeLimit(env_class(), EPISODE_STEPS))


def make_envs(n_envs, env_class=Chase, pays_at_end=False):
    """Return a vector environment and its environments."""
    envs = [make_env(env_class) for _ in range(n_envs)]
    return DummyVecEnv([lambda env=env: EpisodicReward(env) if pays_at_end else env for env in envs]), envs


def make_assigner(method="ircr", env_class=Chase, **options):
    """Return an assigner. The default method has no decoder to compile."""
    spaces = {"observation_space": env_class.observation_space, "action_space": env_class.action_space}
    return RecordingAssigner(method, **({"capacity": 300} | spaces | options))


def off_policy(env, credit, kind=TD3, buffer=CreditReplayBuffer, policy="MlpPolicy", buffer_options=None, **settings):
    return kind(
        policy,
        env,
        seed=0,
        device="cpu",
        policy_kwargs={"net_arch": [8]},
        replay_buffer_class=buffer,
        replay_buffer_kwargs={"credit": credit, **(buffer_options or {})},
        **(SMALL_BUFFER | settings),
    )


def on_policy(env, kind=PPO, policy="MlpPolicy", **settings):
    batch = {} if kind is A2C else {"batch_size": 8}
    options = {"n_steps": 32, **batch, **settings}
    return kind(policy, env, seed=0, device="cpu", policy_kwargs={"net_arch": [8]}, **options)


def check_shown(credit, envs):
    check_episodes(credit, envs, atol=1e-6)
    assert credit.store.dropped == 0


@pytest.mark.parametrize(
    ("kind", "env_class", "n_envs", "options"),
    [
        (TD3, Chase, 1, {"action_noise": NormalActionNoise(np.zeros(1), np.ones(1))}),
        (TD3, DictChase, 2, {"buffer": CreditDictReplayBuffer, "policy": "MultiInputPolicy"}),
        long_case(sb3_contrib.TQC, Chase, 3, {}),
        long_case(sb3_contrib.CrossQ, Chase, 2, {}),
        (DQN, Pick, 2, {}),
    ],
)
def test_buffer_steps(kind, env_class, n_envs, options):
    env, envs = make_envs(n_envs, env_class)
    credit = make_assigner(env_class=env_class)
    off_policy(env, credit, kind, **options).learn(45 * n_envs)
    check_shown(credit, envs)


@pytest.mark.parametrize(
    ("kind", "env_class", "policy"),
    [
        (PPO, Pick, "MlpPolicy"),
        (PPO, DictChase, "MultiInputPolicy"),
        long_case(sb3_contrib.RecurrentPPO, Chase, "MlpLstmPolicy"),
        (sb3_contrib.MaskablePPO, MaskedPick, "MlpPolicy"),
    ],
)
def test_callback_steps(kind, env_class, policy):
    env, envs = make_envs(2, env_class)
    credit = make_assigner(env_class=env_class)
    on_policy(env, kind, policy).learn(128, callback=CreditCallback(credit, 5))
    check_shown(credit, envs)


@pytest.mark.parametrize("kind", [SAC, PPO])
def test_groups_are_read_from_info(kind):
    env = TimeLimit(Levels(by_turns=True), EPISODE_STEPS)
    credit = CreditAssigner("bayes", task=levels_spec(), settings=SMALL_CREDIT)
    if kind is PPO:
        on_policy(env, n_steps=64).learn(64, callback=CreditCallback(credit))
    else:
        off_policy(env, credit, SAC, learning_starts=100).learn(60)
    names, episodes = list(credit.group_names), list(credit.store.episodes.values())
    first = names[episodes[0].level]
    assert [names[episode.level] for episode in episodes] == [(first + number) % 40 for number in range(3)]


def test_normalised_buffer():
    """The assigner receives original observations and rewards, and r_hat is not normalised."""
    env, envs = make_envs(2)
    credit = make_assigner()
    model = off_policy(VecNormalize(env), credit)
    model.learn(120)
    check_shown(credit, envs)
    np.random.seed(0)
    sample = model.replay_buffer.sample(8, model.get_vec_normalize_env())
    np.random.seed(0)
    rows, env_indices = np.random.randint(0, 60, 8), np.random.randint(0, 2, 8)
    expected = credit.rewards_at(model.replay_buffer.step_ids[rows, env_indices])
    assert np.abs(expected).max() > 0
    np.testing.assert_array_equal(sample.rewards.numpy().ravel(), expected)


def test_units_and_newest_decoder():
    """r_hat is that of actions in the environment's units. The decoder also learns from episodes that were added before."""
    credit, random = make_assigner("rrdu"), np.random.default_rng(0)
    for _ in range(5):
        observation, next_observation = random.uniform(-1, 1, (2, 10, 2))
        credit.add_episode(observation, random.uniform(-2, 2, (10, 1)), next_observation, random.normal())
    model = off_policy(make_env(), credit, gradient_steps=2)
    model.learn(120)
    buffer, metrics = model.replay_buffer, credit.metrics()
    assert metrics["credit/episodes"] == 5 + 120 // EPISODE_STEPS
    assert 100 < metrics["credit/fits"] <= 170  # one for each step, not for each update of the algorithm
    assert np.abs(buffer.actions).max() <= 1
    assert np.abs([row[2] for row in credit.recorded.values()]).max() > 1
    rows = slice(0, buffer.pos)
    r_hat = credit.rewards(buffer.observations[rows, 0], 2 * buffer.actions[rows, 0], buffer.next_observations[rows, 0])
    before = buffer.rewards[rows, 0]
    np.testing.assert_allclose(r_hat, before, atol=1e-5)
    credit.fit(48)
    assert np.abs(buffer.rewards[rows, 0] - before).max() > 1e-4
    np.random.seed(0)
    sample = buffer.sample(8).rewards.numpy().ravel()
    np.random.seed(0)
    np.testing.assert_array_equal(sample, buffer.rewards[np.random.randint(0, 120, 8), 0])


class RolloutRecorder(BaseCallback):
    """Records what the rollout buffer holds before the algorithm learns from it."""

    def __init__(self, credit):
        super().__init__()
        self.credit, self.terminal = credit, {}

    def _value(self, observation):
        with torch.no_grad():
            return self.model.policy.predict_values(self.model.policy.obs_to_tensor(observation)[0]).numpy().ravel()

    def _on_step(self):
        for env_index in np.flatnonzero(self.locals["dones"]):
            step = (self.num_timesteps // 2 - 1, int(env_index))
            self.terminal[step] = self._value(self.locals["infos"][env_index]["terminal_observation"])[0]
        return True

    def _on_rollout_end(self):
        buffer, n_steps = self.model.rollout_buffer, self.credit.store.n_added
        names = ("rewards", "values", "advantages", "episode_starts")
        self.buffer = {name: getattr(buffer, name).copy() for name in names}
        self.r_hat = self.credit.rewards_at(
            np.arange(n_steps - buffer.rewards.size, n_steps).reshape(buffer.rewards.shape)
        )
        self.bootstrap = np.zeros_like(self.r_hat)
        for step, value in self.terminal.items():
            self.bootstrap[step] = self.model.gamma * value
        self.next_value, self.dones = self._value(self.model._last_obs), self.locals["dones"]


@pytest.mark.parametrize(("kind", "normalised"), [(PPO, True), (A2C, False), long_case(sb3_contrib.TRPO, False)])
def test_rewards_and_advantages_by_hand(kind, normalised):
    env, envs = make_envs(2)
    credit = make_assigner()
    recorder = RolloutRecorder(credit)
    model = on_policy(VecNormalize(env) if normalised else env, kind, gae_lambda=0.9)
    model.learn(64, callback=[CreditCallback(credit, 20), recorder])
    check_shown(credit, envs)
    assert np.abs(recorder.r_hat).max() > 0
    assert np.count_nonzero(recorder.bootstrap) == 2
    reward, value = recorder.buffer["rewards"], recorder.buffer["values"]
    np.testing.assert_allclose(reward, recorder.r_hat + recorder.bootstrap, atol=1e-6)
    advantage, next_value, discount = np.zeros(2), recorder.next_value, model.gamma * ~recorder.dones
    for t in reversed(range(32)):
        advantage = reward[t] + discount * next_value - value[t] + 0.9 * discount * advantage
        np.testing.assert_allclose(recorder.buffer["advantages"][t], advantage, atol=1e-5)
        next_value, discount = value[t], model.gamma * (1 - recorder.buffer["episode_starts"][t])


def learn_again(model, credit, n_steps, resets, **options):
    """Call `learn` several times. Return the number of dropped episodes after each call."""
    n_dropped = []
    for reset in resets:
        model.learn(n_steps, reset_num_timesteps=reset, **options)
        n_dropped.append(credit.metrics()["credit/dropped"])
    assert {len(episode.step_ids) for episode in credit.store.episodes.values()} == {EPISODE_STEPS}
    return n_dropped


@pytest.mark.long
def test_second_learn_drops_running_episodes():
    """Unless it continues the first one (`reset_num_timesteps=False`)."""
    credit = make_assigner()
    assert learn_again(off_policy(make_envs(3)[0], credit), credit, 90, [True, True, False]) == [0, 3, 3]
    credit = make_assigner(capacity=1000)
    callback = CreditCallback(credit, 5)
    assert learn_again(on_policy(make_envs(3)[0]), credit, 96, [True, True, False], callback=callback) == [0, 3, 3]
    credit = make_assigner()
    model = on_policy(make_envs(1, ConstantChase)[0])
    assert learn_again(model, credit, 32, [True, True], callback=CreditCallback(credit, 5)) == [0, 1]
    model.set_env(model.get_env())  # the next `learn` resets the environments
    assert learn_again(model, credit, 32, [False], callback=CreditCallback(credit, 5)) == [2]
    assert "compute_returns_and_advantage" not in vars(model.rollout_buffer)
    model.learn(32)  # without the callback, by the environment's rewards
    assert np.abs(model.rollout_buffer.rewards).max() > 0


def test_rest_of_an_episode_whose_beginning_was_not_seen(tmp_path):
    """By a callback that comes later, and by a replay buffer that is loaded without its running episodes."""
    model, credit = on_policy(make_envs(1)[0]), make_assigner(capacity=1000)
    model.learn(32)
    model.learn(64, callback=CreditCallback(credit, 5), reset_num_timesteps=False)
    assert episode_lengths(credit) == [EPISODE_STEPS] * 2

    model = off_policy(make_env(), make_assigner())
    model.learn(30)
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    model.load_replay_buffer(tmp_path / "buffer.pkl")
    model.learn(40, reset_num_timesteps=False)
    assert episode_lengths(model.replay_buffer.credit) == [EPISODE_STEPS] * 2


def episode_lengths(credit):
    return [len(episode.step_ids) for episode in credit.store.episodes.values()]


def test_save_and_load(tmp_path):
    """The file of a model has no episodes, the file of a replay buffer has them."""
    credit = make_assigner("rrdu", capacity=20_000)
    model = off_policy(make_env(), credit, buffer_size=20_000)
    model.learn(90)
    steps = [np.float32(array) for array in (np.random.rand(5, 2), np.random.rand(5, 1), np.random.rand(5, 2))]
    model.save(tmp_path / "model.zip")
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    assert (tmp_path / "model.zip").stat().st_size < 300_000

    loaded = TD3.load(tmp_path / "model.zip", env=make_env(), device="cpu")
    credit_1 = loaded.replay_buffer.credit
    assert credit_1.store.n_added == 0
    np.testing.assert_array_equal(credit_1.rewards(*steps), credit.rewards(*steps))
    loaded.learn(60)
    assert credit_1.metrics()["credit/episodes"] == 4 + 3
    assert len(credit_1.store.episodes) == 3

    loaded = TD3.load(tmp_path / "model.zip", env=make_env(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer.pkl")
    buffer = loaded.replay_buffer
    assert buffer.credit is not credit
    np.testing.assert_array_equal(buffer.credit.rewards(*steps), credit.rewards(*steps))
    np.testing.assert_array_equal(buffer.rewards[:90, 0], model.replay_buffer.rewards[:90, 0])
    loaded.learn(120, reset_num_timesteps=False)
    metrics = buffer.credit.metrics()
    assert (metrics["credit/episodes"], metrics["credit/dropped"]) == (4 + 6, 1)
    assert metrics["credit/fits"] > credit.metrics()["credit/fits"]


def test_n_step_returns():
    options = {"n_steps": 3, "gamma": 0.5}
    model = off_policy(make_env(), make_assigner(), buffer=CreditNStepReplayBuffer, buffer_options=options)
    model.learn(70)
    reward = model.replay_buffer.rewards[:70, 0]
    assert len(set(reward)) > 2
    rows = np.array([0, 17, 18, 19, 66, 67, 68, 69])
    returns = model.replay_buffer._get_samples(rows).rewards.numpy().ravel()
    for t, return_ in zip(rows, returns, strict=True):
        end = min(t + 3, (t // EPISODE_STEPS + 1) * EPISODE_STEPS, 70)
        assert return_ == pytest.approx(sum(0.5**k * reward[t + k] for k in range(end - t)))


def test_full_buffer():
    credit = make_assigner(capacity=99)
    buffer = off_policy(make_envs(3)[0], credit, buffer_size=100).learn(250).replay_buffer
    assert buffer.full
    assert buffer.step_ids.min() == credit.store.n_added - 99
    assert np.isfinite(buffer.sample(64).rewards.numpy()).all()
    options = {"optimize_memory_usage": True, "buffer_options": {"handle_timeout_termination": False}}
    buffer = off_policy(make_env(), make_assigner(), buffer_size=50, **options).learn(120).replay_buffer
    assert np.isfinite(buffer.sample(16).rewards.numpy()).all()


def learn_with_callback(env, credit):
    on_policy(env).learn(32, callback=CreditCallback(credit))


@pytest.mark.parametrize(
    ("create", "message"),
    [
        (lambda: TD3("MlpPolicy", make_env(), replay_buffer_class=CreditReplayBuffer), "needs an assigner"),
        (lambda: off_policy(make_env(), make_assigner(capacity=99)), "capacity=300"),
        (lambda: learn_with_callback(make_env(), make_assigner(capacity=31)), "capacity=32"),
        (lambda: off_policy(make_env(), 5), "CreditAssigner, and is 5"),
        (lambda: off_policy(make_env(), make_assigner(action_space=Discrete(1))), "another action_space"),
        (lambda: off_policy(make_env(), make_assigner(action_space=3)), "actions .* 1 numbers.* 3"),
        (
            lambda: off_policy(make_env(DictChase), make_assigner(env_class=DictChase), policy="MultiInputPolicy"),
            "use CreditDictReplayBuffer",
        ),
        (
            lambda: off_policy(make_env(), make_assigner(), buffer_options={"n_sampled_goal": 4}),
            "CreditReplayBuffer cannot relabel goals",
        ),
        (
            lambda: TD3("MlpPolicy", make_env(), **SMALL_BUFFER).learn(10, callback=CreditCallback(make_assigner())),
            "TD3 has none.* replay_buffer_class=CreditReplayBuffer",
        ),
        (
            lambda: on_policy(make_env()).learn(32, callback=EveryNTimesteps(8, CreditCallback(make_assigner()))),
            "must see every step",
        ),
    ],
)
def test_bad_arguments(create, message):
    with pytest.raises(LareError, match=message):
        create()


def test_learning_without_the_callback_after_an_interrupt():
    class Interrupt(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 20:
                raise KeyboardInterrupt
            return True

    credit, model = make_assigner(), on_policy(make_env())
    with pytest.raises(KeyboardInterrupt):
        model.learn(64, callback=[CreditCallback(credit), Interrupt()])
    model.learn(32)
    assert len(credit.recorded) == 20
    model.learn(32, callback=CreditCallback(credit), reset_num_timesteps=False)
    assert len(credit.recorded) == 52
