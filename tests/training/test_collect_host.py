"""Collecting from environments on the host: side by side, back into the middle of an episode, faults with their place."""

import signal
from dataclasses import replace
from functools import partial

import gymnasium
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lare_rl
from helpers.jax_toys import Echo, echo_spec
from helpers.tiers import long
from helpers.toys import At, figures, toy_spec
from lare_rl.envs.families import FAMILIES, Family, make_host_env
from lare_rl.envs.guarded_gymnasium import EnvironmentFault
from lare_rl.envs.gymnasium_env import GymnasiumEnv
from lare_rl.envs.interface import EnvSpec, Team, env_action
from lare_rl.envs.jax_on_host import OnHost
from lare_rl.envs.workers import LocalEnvs, WorkerEnvs
from lare_rl.training.collect_host import Diverged, HostEpisodes, evaluate
from lare_rl.training.streams import Stream, episode_seed
from lare_rl.training.train import Interrupted


class Given(gymnasium.Wrapper):
    """The toy, in what a test has put around it."""

    around = staticmethod(lambda env: env)

    def __init__(self):
        super().__init__(self.around(gymnasium.make("toys/Chase-v0").unwrapped))


gymnasium.register("toys/Given-v0", entry_point=Given, max_episode_steps=20, disable_env_checker=True)
GIVEN = toy_spec(environment="toys/Given-v0")


@pytest.fixture
def giving(monkeypatch):
    """Lets toys/Given-v0 be the toy in a wrapper."""
    return lambda wrapper: monkeypatch.setattr(Given, "around", staticmethod(wrapper))


def local(count, task=None):
    return LocalEnvs([partial(GymnasiumEnv, task or toy_spec())] * count)


def lanes(seeds=(0, 1), environments=1, task=None):
    made = HostEpisodes(local(len(seeds) * environments, task), seeds, environments)
    made.begin()
    return made


def follow(shown, noise, new):
    """The best policy of the toy, with noise; actions in [-1, 1] are twice that in the environment."""
    return shown.observation[..., :1] / 2 + noise


def quiet(of, time):
    return np.zeros((time, *of.shape, 1, 1), np.float32)


# Actions.


def spec_with(low, high):
    bounds = (np.asarray(bound)[None] for bound in (low, high))
    return EnvSpec((Team("agent", 0, 1),), 1, len(low), False, 5, 0, *bounds)


def test_actions_are_rescaled():
    spec = spec_with(np.float32([-0.4, 0]), np.float32([0.4, 10]))
    for action, want in (([-1, 1], [-0.4, 10]), ([0, 0], [0, 5]), ([-3, 1.5], [-0.4, 10])):
        np.testing.assert_allclose(env_action(np.float32([action]), spec), [want])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@given(low=st.lists(st.floats(-1e3, 1e3, width=32), min_size=1, max_size=3), width=st.floats(0.125, 1e3, width=32))
def test_actions_are_within_their_space_to_the_last_digit(dtype, low, width):
    """Rounding leads beyond a bound that a sum of others should come to, and a coarser number is not the bound."""
    bounds = np.array(low, dtype) / dtype(3), np.array(low, dtype) / dtype(3) + dtype(width)
    space = gymnasium.spaces.Box(*bounds, dtype=dtype)
    for action in (-1, -0.3, 0.99999994, 1):
        taken = env_action(np.full((1, len(low)), action, np.float32), spec_with(space.low, space.high))[0]
        assert space.contains(taken)


def test_what_is_chosen_beyond_the_bounds_is_kept_and_the_bound_is_taken():
    some = lanes()
    steps = some.collect(follow, quiet(some, 5) + 3)
    assert (steps.action > 1).all()
    np.testing.assert_array_equal(steps.taken, 2)


# Steps.


def test_streams_of_random_numbers_are_apart():
    seeds = {episode_seed(seed, stream, number) for seed in range(3) for stream in Stream for number in range(20)}
    assert len(seeds) == 3 * len(Stream) * 20


@pytest.mark.parametrize("environments", [1, 3])
def test_collected_steps_follow_each_other_within_an_episode(environments):
    some = lanes(environments=environments)
    steps = some.collect(follow, quiet(some, 45))
    assert steps.before.observation.shape == (2, 45, environments, 1, 2)
    inside = ~steps.ended[:, :-1]
    np.testing.assert_array_equal(steps.after.observation[:, :-1][inside], steps.before.observation[:, 1:][inside])
    for seed, env in np.ndindex(2, environments):
        np.testing.assert_array_equal(np.flatnonzero(steps.ended[seed, :, env]), [19, 39])
    assert not steps.after.terminated.any()
    np.testing.assert_allclose(steps.taken, 2 * steps.action, rtol=1e-4, atol=1e-6)
    want = -((steps.taken[..., 0] - steps.before.observation[..., 0]) ** 2)
    np.testing.assert_allclose(steps.after.reward, want, rtol=1e-4, atol=1e-6)


def test_every_episode_of_a_seed_has_a_start_of_its_own_and_the_same_beside_others():
    some, alone = lanes((0, 1), 3), lanes((1,), 3)
    steps, of_one = (each.collect(follow, quiet(each, 60)) for each in (some, alone))
    np.testing.assert_array_equal(of_one.before.observation[0], steps.before.observation[1])
    starts = steps.before.observation[:, [0, 20, 40]].reshape(-1, 2)
    assert len(np.unique(starts, axis=0)) == 18


def test_policies_are_told_which_episodes_are_new():
    heard, some = [], lanes((0,), 2)

    def act(shown, noise, new):
        heard.append(new.ravel().tolist())
        return noise

    some.collect(act, quiet(some, 21))
    some.collect(act, quiet(some, 20))
    assert [time for time, new in enumerate(heard) if new == [True, True]] == [0, 20, 40]
    assert heard.count([False, False]) == 38


def test_what_is_collected_is_not_written_into_later():
    some = lanes()
    first = some.collect(follow, quiet(some, 7))
    kept = first.before.observation.copy(), first.after.observation.copy(), first.taken.copy()
    some.collect(follow, quiet(some, 30) + 0.1)
    for now, then in zip((first.before.observation, first.after.observation, first.taken), kept, strict=True):
        np.testing.assert_array_equal(now, then)


def test_what_terminates_is_told_from_what_runs_out_of_time(giving):
    class Short(gymnasium.Wrapper):
        def step(self, action):
            observation, reward, _, truncated, info = self.env.step(action)
            self.steps += 1
            return observation, reward, self.steps == 7, truncated, info

        def reset(self, **options):
            self.steps = 0
            return self.env.reset(**options)

    giving(Short)
    for limit, ends, terminated in ((5, [4, 9, 14, 19], []), (9, [6, 13], [6, 13])):
        some = lanes((0,), task=GIVEN.model_copy(update={"max_episode_steps": limit}))
        steps = some.collect(follow, quiet(some, 20))
        np.testing.assert_array_equal(np.flatnonzero(steps.ended[0]), ends)
        np.testing.assert_array_equal(np.flatnonzero(steps.after.terminated[0]), terminated)


# Back into the middle of an episode.


@pytest.mark.parametrize("environments", [1, 2])
def test_replaying_actions_leads_back(environments):
    first, second = lanes(environments=environments), lanes(environments=environments)
    first.collect(follow, quiet(first, 27))
    saved = first.saved()
    assert second.restore(saved) == []
    assert not second.dropped.any()
    again = [one.collect(follow, quiet(one, 25)) for one in (first, second)]
    np.testing.assert_array_equal(again[0].before.observation, again[1].before.observation)
    np.testing.assert_array_equal(again[0].after.observation, again[1].after.observation)


def test_an_episode_that_cannot_be_had_again_is_dropped_and_the_others_are_not():
    first, second = lanes((0, 4), 2), lanes((0, 4), 2)
    first.collect(follow, quiet(first, 27))
    saved = first.saved()
    saved["observation3"] = saved["observation3"] + 1
    assert second.restore(saved) == [
        "episode 1 of seed 4 was dropped after 7 steps: the same actions did not lead to the same observation again"
    ]
    assert second.dropped.tolist() == [False, False, False, True]
    assert second.episode.tolist() == [1, 1, 1, 2]
    assert [len(actions) for actions in second.actions] == [7, 7, 7, 0]


def test_an_environment_that_ends_sooner_when_it_is_played_again_does_not_lead_back(giving):
    """And is not stepped after its end, which some refuse."""
    lives = iter((9, 2, 9))

    class Chancy(gymnasium.Wrapper):
        def reset(self, *, seed=None, options=None):
            self.left = next(lives)
            return np.zeros(2, np.float32), self.env.reset()[1]

        def step(self, action):
            assert self.left, "step after the end"
            self.left -= 1
            return np.zeros(2, np.float32), 0.0, not self.left, False, {}

    giving(Chancy)
    one = lanes((0,), task=GIVEN)
    one.collect(follow, quiet(one, 5))
    one.restore(one.saved())
    assert one.dropped.tolist() == [True]


def test_an_environment_that_writes_into_one_array_is_stored_as_it_was_then(giving):
    class Counts(gymnasium.Wrapper):
        state = np.zeros(2, np.float32)

        def reset(self, *, seed=None, options=None):
            self.state[:] = 0
            return self.state, self.env.reset()[1]

        def step(self, action):
            self.env.step(action)
            self.state += 1
            return self.state, 0.0, False, False, {}

    giving(Counts)
    one = lanes((0,), task=GIVEN)
    steps = one.collect(follow, quiet(one, 3))
    np.testing.assert_array_equal(steps.before.observation[0, :, 0, 0, 0], [0, 1, 2])
    np.testing.assert_array_equal(steps.after.observation[0, :, 0, 0, 0], [1, 2, 3])
    saved = one.saved()
    one.collect(follow, quiet(one, 2))
    assert (saved["observation0"] == 3).all()


@pytest.mark.parametrize(("kind", "algorithm"), [long(LocalEnvs, "td3"), (WorkerEnvs, "ppo")])
def test_a_run_of_two_environments_a_seed_resumes_bit_for_bit(kind, algorithm, small, tmp_path, monkeypatch):
    """In this process, and in processes of their own."""
    monkeypatch.setattr("lare_rl.training.collect_host.WorkerEnvs", kind)
    task = toy_spec(environment="helpers.toys:toys/Chase-v0")
    settings = small(method="rrdu", algorithm=algorithm, environments=2, steps=192, evaluate_every=48, seeds=2)
    whole = lare_rl.train(task, settings, out=tmp_path / "whole", listeners=[])
    assert [line["step"] for line in whole.metrics()[::2]] == [48, 96, 144, 192]
    stop = At(72, lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(Interrupted):
        lare_rl.train(task, settings, out=tmp_path / "run", listeners=[stop])
    assert figures(lare_rl.resume(tmp_path / "run", listeners=[])) == figures(whole)


@pytest.mark.parametrize("algorithm", [long("qmix"), "ippo"])
def test_many_agents_on_the_host_resume_bit_for_bit(algorithm, small_many, tmp_path, monkeypatch):
    """In the middle of episodes of which the agents remember something, and after somebody has left."""

    def hosted(task, **_):
        env = OnHost(Echo())
        env.spec = replace(env.spec, in_jax=False)
        return env

    monkeypatch.setitem(FAMILIES, "hosted", Family(hosted))
    monkeypatch.setattr("lare_rl.training.collect_host.WorkerEnvs", LocalEnvs)
    task = echo_spec(environment="hosted/three")
    changes = {"environments": 2, "rollout_steps": 10, "steps": 160, "evaluate_every": 40, "evaluation_episodes": 2}
    settings = small_many(algorithm=algorithm, method="rrdu", seeds=1, **changes)
    whole = lare_rl.train(task, settings, out=tmp_path / "whole", listeners=[])
    stop = At(100, lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(Interrupted):
        lare_rl.train(task, settings, out=tmp_path / "run", listeners=[stop])
    assert figures(lare_rl.resume(tmp_path / "run", listeners=[])) == figures(whole)
    assert 3 <= whole.metrics()[-1]["evaluation/length"] <= 6


def test_environments_in_processes_of_their_own_give_the_same():
    maker = partial(make_host_env, toy_spec(environment="helpers.toys:toys/Chase-v0"))
    with WorkerEnvs([maker] * 4) as workers:
        there, here = HostEpisodes(workers, (0, 1), 2), lanes((0, 1), 2)
        there.begin()
        one, other = (each.collect(follow, quiet(each, 25)) for each in (there, here))
    for a, b in zip((*one.before[:-1], *one.after[:-1]), (*other.before[:-1], *other.after[:-1]), strict=True):
        np.testing.assert_array_equal(a, b)


# Evaluations.


def doing(share):
    return lambda shown, new: share * shown.observation[..., :1] / 2


def test_evaluations_start_alike_and_pay_the_true_return():
    def one(seeds=(0, 1), first=0, share=0.0):
        return evaluate(local(3 * len(seeds)), doing(share), seeds, 3, first=first).returns[..., 0]

    returns = one()
    assert len(set(returns.ravel())) == 6
    np.testing.assert_array_equal(one(), returns)
    np.testing.assert_array_equal(one((1, 2))[0], returns[1])
    np.testing.assert_array_equal(one(first=1)[:, :2], returns[:, 1:])
    np.testing.assert_allclose(one(share=1.0), 0, atol=1e-4)  # the best policy of the toy
    environment = gymnasium.make("toys/Chase-v0")
    for (seed, place), paid in np.ndenumerate(returns):
        observation, _ = environment.reset(seed=episode_seed(seed, Stream.EVALUATION_EPISODES, place))
        total = 0.0
        for _ in range(20):
            total -= observation[0] ** 2
            observation, *_ = environment.step(np.zeros(1, np.float32))
        assert paid == pytest.approx(total, rel=1e-4)


def test_evaluation_of_episodes_of_different_lengths(giving):
    lengths = iter((3, 1, 7))

    class Counts(gymnasium.Wrapper):
        def reset(self, *, seed=None, options=None):
            self.left = next(lengths)
            return self.env.reset(seed=seed)

        def step(self, action):
            assert self.left > 0, "stepped after the end"
            self.left -= 1
            observation, *_ = self.env.step(action)
            return observation, 1.0, self.left == 0, False, {"left": self.left}

    giving(Counts)
    found = evaluate(local(3, GIVEN.model_copy(update={"measures": ("left",)})), doing(0.0), [0], 3)
    np.testing.assert_array_equal(found.returns[..., 0], [[3, 1, 7]])
    np.testing.assert_array_equal(found.sums, found.returns)
    np.testing.assert_array_equal(found.lengths, [[3, 1, 7]])
    np.testing.assert_array_equal(found.measures["left"], [[0, 0, 0]])


# What goes wrong.


def test_a_policy_that_is_nan_is_not_blamed_on_the_environment():
    message = "training diverged: the policy of seed 1 is not finite any more; the last checkpoint is whole"
    spoilt, some = np.float32([[[[0]]], [[[np.nan]]]]), lanes()
    with pytest.raises(Diverged) as error:
        some.collect(lambda shown, noise, new: spoilt, quiet(some, 1))
    assert str(error.value) == message
    with pytest.raises(Diverged) as error:
        evaluate(local(2), lambda shown, new: spoilt, (0, 1), 1)
    assert str(error.value) == message


class Gives(gymnasium.Wrapper):
    """Something else than an observation, or a reward, after the third step, in episodes of some seeds."""

    def __init__(self, env, given=None, seeds=range(2**31), reward=False):
        super().__init__(env)
        self.given, self.seeds, self.reward = given, seeds, reward

    def reset(self, *, seed=None, options=None):
        self.spoilt, self.steps = seed in self.seeds, 0
        return super().reset(seed=seed, options=options)

    def step(self, action):
        observation, reward, *rest = super().step(action)
        self.steps += 1
        if self.spoilt and self.steps == 3:
            return (observation, self.given, *rest) if self.reward else (self.given, reward, *rest)
        return observation, reward, *rest


BAD = [
    (np.array([0.0, np.nan]), "the environment gave nan in its observation"),
    (np.zeros(3), r"the environment gave its observation in shape \(3,\), not \(2,\)"),
    (None, r"the environment gave its observation in shape \(\), not \(2,\)"),
    ("left", "the environment gave 'left' for its observation"),
]


@pytest.mark.parametrize(("environments", "where"), [(1, "seed 4"), (2, "seed 4 in environment 0")])
@pytest.mark.parametrize(("given", "message"), BAD)
def test_an_observation_that_is_none_is_not_learned_from(given, message, environments, where, giving):
    giving(partial(Gives, given=given))
    some = lanes((4,), environments, task=GIVEN)
    with pytest.raises(EnvironmentFault, match=f"^{message}, at step 3 of episode 0 of {where}$"):
        some.collect(follow, quiet(some, 20))


def test_a_fault_is_said_with_its_environment_and_episode(giving):
    """The second episode of the second environment of seed 9, whose number among the seed's episodes is 3."""
    spoilt = episode_seed(9, Stream.TRAINING_EPISODES, 3)
    giving(partial(Gives, given=float("nan"), seeds={spoilt}, reward=True))
    some = lanes((4, 9), 2, task=GIVEN)
    message = "^the environment gave nan in its reward, at step 3 of episode 1 of seed 9 in environment 1$"
    with pytest.raises(EnvironmentFault, match=message):
        some.collect(follow, quiet(some, 40))


@pytest.mark.parametrize(("given", "message"), [*BAD, (float("nan"), "the environment gave nan in its reward")])
def test_nor_is_a_policy_asked_about_it_in_an_evaluation(given, message, giving):
    """A choice of the largest of NaNs is a choice: nobody would know."""
    spoilt = episode_seed(1, Stream.EVALUATION_EPISODES, 2)
    giving(partial(Gives, given=given, seeds={spoilt}, reward=isinstance(given, float)))
    envs = local(4, GIVEN)
    evaluate(envs, doing(0.0), (0, 1), 2)
    with pytest.raises(EnvironmentFault, match=f"^{message}, in an evaluation of seed 1$"):
        evaluate(envs, doing(0.0), (0, 1), 2, first=1)
