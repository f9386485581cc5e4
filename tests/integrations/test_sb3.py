"""Replay buffers and callback, in the algorithms of Stable-Baselines3 and sb3-contrib."""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest
import sb3_contrib
import torch
from gymnasium.spaces import Box, Dict, Discrete
from stable_baselines3 import A2C, DQN, PPO, SAC, TD3, HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, EveryNTimesteps
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import lare_rl
from helpers.toy_envs import Chase, Pick, toy_spec
from lare_rl import CreditAssigner, LareError
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.errors import install_command
from lare_rl.integrations.sb3 import CreditCallback, CreditDictReplayBuffer, CreditNStepReplayBuffer, CreditReplayBuffer

torch.set_num_threads(1)

SMALL_CREDIT = CreditSettings(hidden=(8,), drawn_steps=4, steps=16, episodes=2, encoder=(8,), bottleneck=2)
SMALL_BUFFER = {"learning_starts": 30, "buffer_size": 300, "batch_size": 8, "train_freq": 1, "gradient_steps": 1}
EPISODE_STEPS = 20


class LoggedEnv(gymnasium.Wrapper):
    """Logs (observation, action, next observation, reward, done), and pays each reward at once, in pairs, or at the end.

    Rewards are multiples of 1/64, so that float32 does not round their sums.
    """

    def __init__(self, env, pays="at once"):
        super().__init__(env)
        self.log, self.pays = [], pays

    def reset(self, **options):
        self.observation, info = self.env.reset(**options)
        self.unpaid = 0.0
        return self.observation, info

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        reward, done = np.round(64 * reward) / 64, terminated or truncated
        self.log.append((self.observation, np.array(action), observation, reward, done))
        self.observation = observation
        self.unpaid += reward
        if done or self.pays == "at once" or (self.pays == "in pairs" and len(self.log) % 2 == 0):
            reward, self.unpaid = self.unpaid, 0.0
        else:
            reward = 0.0
        return observation, reward, terminated, truncated, info


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


class RecordingAssigner(CreditAssigner):
    """Records the rows that it is shown."""

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.recorded = []

    def add(self, observation, action, next_observation, *args, **options):
        self.recorded += zip(*self.config.to_rows(observation, action, next_observation), strict=True)
        return super().add(observation, action, next_observation, *args, **options)


def make_env(env_class=Chase, pays="at once"):
    return LoggedEnv(gymnasium.wrappers.TimeLimit(env_class(), EPISODE_STEPS), pays)


def make_envs(n_envs, env_class=Chase, pays="at once"):
    """Return a vector environment and its environments."""
    envs = [make_env(env_class, pays) for _ in range(n_envs)]
    return DummyVecEnv([lambda env=env: env for env in envs]), envs


def make_assigner(method="ircr", env_class=Chase, **options):
    """Return an assigner of the cheapest method."""
    spaces = {"observation_space": env_class.observation_space, "action_space": env_class.action_space}
    return RecordingAssigner(method, **({"settings": SMALL_CREDIT, "capacity": 300} | spaces | options))


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
    """Assert that rows and episodes of the assigner are those of the environments' logs."""
    credit.metrics()
    n_envs, scores = len(envs), {}
    layouts = (credit.config.observation, credit.config.action, credit.config.observation)
    for env_index, env in enumerate(envs):
        *columns, rewards, dones = zip(*env.log, strict=True)
        recorded = zip(*credit.recorded[env_index::n_envs], strict=True)
        for layout, column, rows in zip(layouts, columns, recorded, strict=True):
            expected = np.stack([layout.rows(value, "log") for value in column])
            np.testing.assert_allclose(np.stack(rows), expected.reshape(len(expected), -1), atol=1e-6)
        ends = np.flatnonzero(dones)
        numbers = np.arange(len(env.log)) * n_envs + env_index
        for first, last in zip([0, *ends[:-1] + 1], ends, strict=True):
            scores[tuple(numbers[first : last + 1])] = sum(rewards[first : last + 1])
    stored = {tuple(episode.steps.tolist()): episode.score for episode in credit.store.episodes.values()}
    assert stored == pytest.approx(scores)
    assert credit.store.dropped == 0


def check_units(model, credit):
    """Assert that r_hat is computed from actions in the environment's units."""
    buffer, space = model.replay_buffer, model.action_space

    def stored(values):
        if isinstance(values, dict):
            return {"place": values["place"][: buffer.pos, 0], "side": values["side"][: buffer.pos, 0, 0]}
        return values[: buffer.pos, 0]

    env_action = space.low + 0.5 * (stored(buffer.actions) + 1) * (space.high - space.low)
    r_hat = credit.rewards(stored(buffer.observations), env_action, stored(buffer.next_observations))
    np.testing.assert_allclose(r_hat, buffer.rewards[: buffer.pos, 0], atol=1e-5)


@pytest.mark.parametrize(
    ("kind", "env_class", "n_envs", "pays"),
    [
        (TD3, Chase, 1, "at once"),
        (TD3, Chase, 3, "at the end"),
        *((kind, Chase, 2, "at once") for kind in (SAC, sb3_contrib.TQC, sb3_contrib.CrossQ)),
        *((kind, Pick, 2, "at once") for kind in (DQN, sb3_contrib.QRDQN)),
    ],
)
def test_buffer_steps(kind, env_class, n_envs, pays):
    env, envs = make_envs(n_envs, env_class, pays)
    credit = make_assigner(env_class=env_class)
    noise = {"action_noise": NormalActionNoise(np.zeros(1), np.ones(1))} if kind is TD3 else {}
    off_policy(env, credit, kind, **noise).learn(45 * n_envs)
    check_shown(credit, envs)


@pytest.mark.parametrize(
    ("kind", "env_class", "policy"),
    [
        *((kind, Chase, "MlpPolicy") for kind in (PPO, A2C, sb3_contrib.TRPO)),
        (PPO, Pick, "MlpPolicy"),
        (PPO, DictChase, "MultiInputPolicy"),
        (sb3_contrib.RecurrentPPO, Chase, "MlpLstmPolicy"),
        (sb3_contrib.MaskablePPO, MaskedPick, "MlpPolicy"),
    ],
)
def test_callback_steps(kind, env_class, policy):
    env, envs = make_envs(2, env_class)
    credit = make_assigner(env_class=env_class)
    on_policy(env, kind, policy).learn(128, callback=CreditCallback(credit, 5))
    check_shown(credit, envs)


def test_dict_buffer():
    env, envs = make_envs(2, DictChase)
    credit = make_assigner("rd-linear", DictChase)
    model = off_policy(env, credit, buffer=CreditDictReplayBuffer, policy="MultiInputPolicy")
    model.learn(120)
    check_shown(credit, envs)
    check_units(model, credit)


def test_normalisation():
    """The assigner is shown original observations and rewards, and r_hat is not normalised."""
    env, envs = make_envs(2)
    credit = make_assigner()
    model = off_policy(VecNormalize(env), credit)
    model.learn(120)
    check_shown(credit, envs)
    np.random.seed(0)
    sample = model.replay_buffer.sample(8, model.get_vec_normalize_env())
    np.random.seed(0)
    rows, env_indices = np.random.randint(0, 60, 8), np.random.randint(0, 2, 8)
    expected = credit.rewards_at(model.replay_buffer.steps[rows, env_indices])
    assert np.abs(expected).max() > 0
    np.testing.assert_array_equal(sample.rewards.numpy().ravel(), expected)
    env, envs = make_envs(2)
    credit = make_assigner()
    on_policy(VecNormalize(env)).learn(128, callback=CreditCallback(credit, 5))
    check_shown(credit, envs)


def test_units_and_logged_episodes():
    """The decoder also learns from episodes that were added before."""
    credit, random = make_assigner("rd-linear"), np.random.default_rng(0)
    for _ in range(5):
        observation, next_observation = random.uniform(-1, 1, (2, 10, 2))
        credit.add_episode(observation, random.uniform(-2, 2, (10, 1)), next_observation, random.normal())
    model = off_policy(make_env(), credit)
    model.learn(120)
    assert credit.metrics()["credit/episodes"] == 5 + 120 // EPISODE_STEPS
    assert np.abs(model.replay_buffer.actions).max() <= 1
    assert np.abs([action for _, action, _ in credit.recorded]).max() > 1
    check_units(model, credit)


@pytest.mark.parametrize("algorithm", ["td3", "ppo"])
def test_policy_depends_on_returns_only(algorithm):
    """Not on when rewards are paid."""
    weights = []
    for pays in ("at once", "at the end", "in pairs"):
        env, _ = make_envs(2, pays=pays)
        credit = make_assigner("rrdu")
        if algorithm == "td3":
            model = off_policy(env, credit)
            model.learn(120)
        else:
            model = on_policy(env)
            model.learn(192, callback=CreditCallback(credit, 5))
        assert credit.metrics()["credit/fits"] > 0
        weights.append({name: value.numpy().copy() for name, value in model.policy.state_dict().items()})
    for other in weights[1:]:
        for name, values in other.items():
            np.testing.assert_array_equal(values, weights[0][name])


def test_newest_decoder():
    credit = make_assigner("rrdu")
    model = off_policy(make_env(), credit)
    model.learn(90)
    rewards = model.replay_buffer.rewards
    before = rewards[:60, 0]
    credit.fit(50)
    assert np.abs(rewards[:60, 0] - before).max() > 1e-4
    np.random.seed(0)
    sample = model.replay_buffer.sample(8).rewards.numpy().ravel()
    np.random.seed(0)
    np.testing.assert_array_equal(sample, rewards[np.random.randint(0, 90, 8), 0])


def test_number_of_decoder_updates():
    """It depends on the steps, not on the algorithm's own updates."""
    credit = make_assigner("rrdu")
    off_policy(make_envs(2)[0], credit, gradient_steps=5).learn(200)
    assert 150 < credit.metrics()["credit/fits"] <= 200


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
        buffer, n_steps = self.model.rollout_buffer, self.credit.store.steps
        names = ("rewards", "values", "advantages", "episode_starts")
        self.buffer = {name: getattr(buffer, name).copy() for name in names}
        self.r_hat = self.credit.rewards_at(
            np.arange(n_steps - buffer.rewards.size, n_steps).reshape(buffer.rewards.shape)
        )
        self.bootstrap = np.zeros_like(self.r_hat)
        for step, value in self.terminal.items():
            self.bootstrap[step] = self.model.gamma * value
        self.next_value, self.dones = self._value(self.model._last_obs), self.locals["dones"]


@pytest.mark.parametrize("kind", [PPO, A2C, sb3_contrib.TRPO])
@pytest.mark.parametrize("normalised", [False, True])
def test_rewards_and_advantages_by_hand(kind, normalised):
    env, _ = make_envs(2)
    credit = make_assigner()
    recorder = RolloutRecorder(credit)
    model = on_policy(VecNormalize(env) if normalised else env, kind, gae_lambda=0.9)
    model.learn(64, callback=[CreditCallback(credit, 20), recorder])
    assert np.abs(recorder.r_hat).max() > 0
    assert np.count_nonzero(recorder.bootstrap) == 2
    reward, value = recorder.buffer["rewards"], recorder.buffer["values"]
    np.testing.assert_allclose(reward, recorder.r_hat + recorder.bootstrap, atol=1e-6)
    advantage, next_value, discount = np.zeros(2), recorder.next_value, model.gamma * ~recorder.dones
    for t in reversed(range(32)):
        advantage = reward[t] + discount * next_value - value[t] + 0.9 * discount * advantage
        np.testing.assert_allclose(recorder.buffer["advantages"][t], advantage, atol=1e-5)
        next_value, discount = value[t], model.gamma * (1 - recorder.buffer["episode_starts"][t])


def lengths(credit):
    return {len(episode.steps) for episode in credit.store.episodes.values()}


def test_second_learn_drops_running_episodes():
    """Unless it continues the first one (`reset_num_timesteps=False`)."""
    credit = make_assigner()
    model = off_policy(make_envs(3)[0], credit)
    n_dropped = []
    for n_steps, reset in ((90, True), (60, True), (60, False)):
        model.learn(n_steps, reset_num_timesteps=reset)
        n_dropped.append(credit.metrics()["credit/dropped"])
    assert n_dropped == [0, 3, 3]
    assert lengths(credit) == {EPISODE_STEPS}
    credit = make_assigner(capacity=1000)
    model = on_policy(make_envs(3)[0])
    n_dropped = []
    for reset in (True, True, False):
        model.learn(96, callback=CreditCallback(credit, 5), reset_num_timesteps=reset)
        n_dropped.append(credit.metrics()["credit/dropped"])
    assert n_dropped == [0, 3, 3]
    assert lengths(credit) == {EPISODE_STEPS}
    credit = make_assigner()
    model = on_policy(make_envs(1, ConstantChase)[0])
    for _ in range(2):
        model.learn(32, callback=CreditCallback(credit, 5))
    assert credit.metrics()["credit/dropped"] == 1
    assert lengths(credit) == {EPISODE_STEPS}


def mean_return(model, episodes=20):
    """Return the mean true return of the policy without noise."""
    env, total = gymnasium.wrappers.TimeLimit(Chase(), EPISODE_STEPS), 0.0
    for seed in range(episodes):
        (observation, _), done = env.reset(seed=1000 + seed), False
        while not done:
            action, _ = model.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, _ = env.step(action)
            total, done = total + reward, terminated or truncated
    return total / episodes


def test_learns_from_returns(phi):
    """Returns of three seeds: -0.12 to -0.19 with r_hat, -0.13 to -0.19 with true rewards, -19 to -54 without; random -33."""
    env = lare_rl.EpisodicReward(gymnasium.wrappers.TimeLimit(Chase(), EPISODE_STEPS))
    credit = CreditAssigner("lare-bayes", phi, task=toy_spec(), capacity=3000)
    model = TD3(
        "MlpPolicy",
        env,
        replay_buffer_class=CreditReplayBuffer,
        replay_buffer_kwargs={"credit": credit},
        learning_starts=200,
        buffer_size=3000,
        batch_size=64,
        gamma=0.9,
        policy_kwargs={"net_arch": [32]},
        action_noise=NormalActionNoise(np.zeros(1), 0.3 * np.ones(1)),
        seed=0,
        device="cpu",
    )
    model.learn(1500)
    assert mean_return(model) > -1
    assert credit.metrics()["credit/return_r2"] > 0.99


def test_save_and_load(tmp_path, phi):
    """The file of a model has no episodes, the file of a replay buffer has them."""
    credit = CreditAssigner("lare-rrdu", phi, task=toy_spec(), settings=SMALL_CREDIT, capacity=20_000)
    model = off_policy(make_env(), credit, buffer_size=20_000)
    model.learn(90)
    steps = [np.float32(array) for array in (np.random.rand(5, 2), np.random.rand(5, 1), np.random.rand(5, 2))]
    model.save(tmp_path / "model.zip")
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    assert (tmp_path / "model.zip").stat().st_size < 300_000

    loaded = TD3.load(tmp_path / "model.zip", env=make_env(), device="cpu")
    credit_1 = loaded.replay_buffer.credit
    assert credit_1.store.steps == 0
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
    model = off_policy(make_envs(3)[0], credit, buffer_size=100)
    model.learn(250)
    buffer = model.replay_buffer
    assert buffer.full
    assert buffer.steps.min() == credit.store.steps - 99
    assert np.isfinite(buffer.sample(64).rewards.numpy()).all()


def test_optimize_memory_usage():
    credit = make_assigner()
    options = {"optimize_memory_usage": True, "buffer_options": {"handle_timeout_termination": False}}
    model = off_policy(make_env(), credit, buffer_size=50, **options)
    model.learn(120)
    assert credit.metrics()["credit/episodes"] == 6
    assert np.isfinite(model.replay_buffer.sample(16).rewards.numpy()).all()


class GoalBuffer(CreditDictReplayBuffer, HerReplayBuffer):
    pass


def learn_with_callback(env, credit):
    on_policy(env).learn(32, callback=CreditCallback(credit))


@pytest.mark.parametrize(
    ("create", "message"),
    [
        (lambda: TD3("MlpPolicy", make_env(), replay_buffer_class=CreditReplayBuffer), "needs an assigner"),
        (lambda: off_policy(make_env(), make_assigner(capacity=99)), "capacity=300"),
        (lambda: learn_with_callback(make_env(), make_assigner(capacity=31)), "capacity=32"),
        (lambda: off_policy(make_env(), make_assigner(action_space=3)), "actions .* 1 numbers.* 3"),
        (lambda: learn_with_callback(make_env(), make_assigner(observation_space=4)), "observations .* 2 numbers.* 4"),
        (lambda: off_policy(make_env(), make_assigner("rd", agents=2, max_steps=20)), "agents=2.* has 1"),
        (
            lambda: off_policy(make_env(DictChase), make_assigner(env_class=DictChase), policy="MultiInputPolicy"),
            "use CreditDictReplayBuffer",
        ),
        (lambda: off_policy(make_env(), make_assigner(), buffer=CreditDictReplayBuffer), "use CreditReplayBuffer"),
        (
            lambda: GoalBuffer(10, DictChase.observation_space, DictChase.action_space, credit=make_assigner()),
            "GoalBuffer cannot relabel goals",
        ),
        (
            lambda: off_policy(make_env(), make_assigner(), buffer_options={"n_sampled_goal": 4}),
            "CreditReplayBuffer cannot relabel goals",
        ),
        (
            lambda: TD3("MlpPolicy", make_env(), **SMALL_BUFFER).learn(10, callback=CreditCallback(make_assigner())),
            r"TD3\(\.\.\., replay_buffer_class=CreditReplayBuffer",
        ),
        (
            lambda: on_policy(make_env()).learn(32, callback=EveryNTimesteps(8, CreditCallback(make_assigner()))),
            "saw 4 of the 32 steps",
        ),
    ],
)
def test_bad_arguments(create, message):
    with pytest.raises(LareError, match=message):
        create()


def test_learn_without_callback_uses_true_rewards():
    model = on_policy(make_env())
    model.learn(32, callback=CreditCallback(make_assigner(), 1))
    model.learn(32)
    assert "compute_returns_and_advantage" not in vars(model.rollout_buffer)
    assert np.abs(model.rollout_buffer.rewards).max() > 0


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("sys.modules['stable_baselines3'] = None", install_command("sb3")),
        ("import stable_baselines3; stable_baselines3.__version__ = '2.8.0'", "2.8.0 is installed"),
    ],
)
def test_library_is_missing_or_old(line, message):
    program = f"import sys\n{line}\ntry:\n import lare_rl.integrations.sb3\nexcept Exception as error:\n print(error)"
    output = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert message in output
