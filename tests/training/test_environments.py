import gymnasium
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lare.errors import LareError
from lare.tasks.episodic import EpisodicReward
from lare.training import environments
from lare.training.environments import Lane, Stream, collect, episode_seed, evaluate, make_episodic, to_bounds
from toys import toy_spec


def lane(seed=0):
    made = Lane(seed, make_episodic(toy_spec()))
    made.begin()
    return made


def follow(observation, noise):
    """The best policy of the toy, with noise."""
    return observation[:, :1] + noise


def test_actions_are_rescaled():
    space = gymnasium.spaces.Box(np.float32([-0.4, 0]), np.float32([0.4, 10]))
    np.testing.assert_allclose(to_bounds(np.float32([-1, 1]), space), [-0.4, 10])
    np.testing.assert_allclose(to_bounds(np.float32([0, 0]), space), [0, 5])
    np.testing.assert_allclose(to_bounds(np.float32([-3, 1.5]), space), [-0.4, 10])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@given(low=st.lists(st.floats(-1e3, 1e3, width=32), min_size=1, max_size=3), width=st.floats(0.125, 1e3, width=32))
def test_actions_are_within_their_space_to_the_last_digit(dtype, low, width):
    """Rounding leads beyond a bound that a sum of others should come to, and a coarser number is not the bound."""
    bounds = np.array(low, dtype) / dtype(3), np.array(low, dtype) / dtype(3) + dtype(width)
    space = gymnasium.spaces.Box(*bounds, dtype=dtype)
    for action in (-1, -0.3, 0.99999994, 1):
        assert space.contains(to_bounds(np.full(len(low), action, np.float32), space))


def test_streams_of_random_numbers_are_apart():
    seeds = {episode_seed(seed, stream, number) for seed in range(3) for stream in Stream for number in range(20)}
    assert len(seeds) == 3 * len(Stream) * 20


def test_collected_steps_follow_each_other_within_an_episode():
    lanes = [lane(0), lane(1)]
    collected = collect(lanes, follow, np.zeros((45, 2, 1), np.float32))
    steps = collected.steps
    assert steps.observation.shape == (2, 45, 2)
    inside = ~steps.ended[:, :-1]
    np.testing.assert_array_equal(steps.next_observation[:, :-1][inside], steps.observation[:, 1:][inside])
    np.testing.assert_array_equal(np.flatnonzero(steps.ended[0]), [19, 39])
    assert not steps.terminated.any()
    np.testing.assert_allclose(collected.environment_action, 2 * steps.action, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(
        steps.reward, -((collected.environment_action[..., 0] - steps.observation[..., 0]) ** 2), rtol=1e-4, atol=1e-6
    )


def test_what_is_chosen_beyond_the_bounds_is_kept_and_the_bound_is_taken():
    collected = collect([lane()], follow, np.full((5, 1, 1), 3, np.float32))
    assert (collected.steps.action > 1).all()
    np.testing.assert_array_equal(collected.environment_action, 2)


def test_replaying_actions_leads_back():
    first, second = lane(), lane()
    collect([first], follow, np.zeros((27, 1, 1), np.float32))
    second.episode = first.episode
    assert second.replay(first.actions, first.observation)
    again = [collect([one], follow, np.zeros((5, 1, 1), np.float32)).steps for one in (first, second)]
    np.testing.assert_array_equal(again[0].next_observation, again[1].next_observation)
    assert not second.replay(first.actions[:3], first.observation)


def test_an_environment_that_ends_sooner_when_it_is_played_again_does_not_lead_back():
    """And is not stepped after its end, which some refuse."""

    class Chancy(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-99, 99, (1,), np.float32)
        action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
        lives = iter((9, 2))

        def reset(self, *, seed=None, options=None):
            self.left = next(self.lives)
            return np.zeros(1, np.float32), {}

        def step(self, action):
            assert self.left, "step after the end"
            self.left -= 1
            return np.zeros(1, np.float32), 0.0, not self.left, False, {}

    one = Lane(0, EpisodicReward(Chancy()))
    one.begin()
    for _ in range(5):
        one.step(np.zeros(1, np.float32))
    assert not one.replay(one.actions, one.observation)


def test_an_environment_that_writes_into_one_array_is_stored_as_it_was_then():
    class Counts(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-99, 99, (1,), np.float32)
        action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

        def __init__(self):
            self.state = np.zeros(1, np.float32)

        def reset(self, *, seed=None, options=None):
            self.state[:] = 0
            return self.state, {}

        def step(self, action):
            self.state += 1
            return self.state, 0.0, False, False, {}

    whole, resumed = (Lane(0, EpisodicReward(Counts())) for _ in range(2))
    for one in (whole, resumed):
        one.begin()
    for _ in range(3):
        whole.step(np.zeros(1, np.float32))
    assert resumed.replay(whole.actions, whole.observation)
    for one in (whole, resumed):
        before, _, _, after, _, _ = one.step(np.zeros(1, np.float32))
        assert (before, after) == (3, 4)


def test_a_policy_that_is_nan_is_not_blamed_on_the_environment():
    message = "training diverged: the policy of seed 1 is not finite any more; the last checkpoint is whole"
    lanes, spoilt = [lane(0), lane(1)], np.float32([[[0], [np.nan]]])
    with pytest.raises(environments.Diverged) as error:
        collect(lanes, follow, spoilt)
    assert str(error.value) == message
    with pytest.raises(environments.Diverged) as error:
        evaluate([[make_episodic(toy_spec())] for _ in range(2)], lambda o: spoilt.swapaxes(0, 1), (0, 1))
    assert str(error.value) == message


def test_evaluations_start_alike_and_pay_the_true_return():
    def one(seeds=(0, 1), first=0, share=0.0):
        made = [[make_episodic(toy_spec()) for _ in range(3)] for _ in seeds]
        return evaluate(made, lambda o: share * o[..., :1], seeds, first=first).returns

    returns = one()
    assert len(set(returns.ravel())) == 6
    np.testing.assert_array_equal(one(), returns)
    np.testing.assert_array_equal(one((1, 2))[0], returns[1])
    np.testing.assert_array_equal(one(first=1)[:, :2], returns[:, 1:])
    np.testing.assert_allclose(one(share=0.5), 0, atol=1e-4)  # the best policy of the toy
    environment = make_episodic(toy_spec())
    for (seed, place), paid in np.ndenumerate(returns):
        observation, _ = environment.reset(seed=episode_seed(seed, Stream.EVALUATION_EPISODES, place))
        total = 0.0
        for _ in range(20):
            total -= observation[0] ** 2
            observation, *_ = environment.step(np.zeros(1, np.float32))
        assert paid == pytest.approx(total, rel=1e-4)


def test_what_terminates_is_told_from_what_runs_out_of_time():
    class Short(gymnasium.Wrapper):
        def step(self, action):
            observation, reward, _, truncated, info = self.env.step(action)
            self.steps += 1
            return observation, reward, self.steps == 7, truncated, info

        def reset(self, **options):
            self.steps = 0
            return self.env.reset(**options)

    lanes = [
        Lane(0, EpisodicReward(Short(gymnasium.make("toys/Chase-v0", max_episode_steps=length)))) for length in (5, 9)
    ]
    for one in lanes:
        one.begin()
    steps = collect(lanes, follow, np.zeros((20, 2, 1), np.float32)).steps
    assert not steps.terminated[0].any()
    np.testing.assert_array_equal(np.flatnonzero(steps.ended[0]), [4, 9, 14, 19])
    np.testing.assert_array_equal(np.flatnonzero(steps.terminated[1]), [6, 13])
    np.testing.assert_array_equal(steps.ended[1], steps.terminated[1])


def test_evaluation_of_episodes_of_different_lengths():
    class Counts(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-1, 1, (1,))
        action_space = gymnasium.spaces.Box(-1, 1, (1,))

        def __init__(self, length):
            self.length = length

        def reset(self, *, seed=None, options=None):
            self.left = self.length
            return np.zeros(1, np.float32), {}

        def step(self, action):
            assert self.left > 0, "stepped after the end"
            self.left -= 1
            return np.zeros(1, np.float32), 1.0, self.left == 0, False, {"left": self.left}

    lengths = (3, 1, 7)
    made = [[EpisodicReward(Counts(length)) for length in lengths]]
    found = evaluate(made, lambda observation: observation, [0], ("left",))
    np.testing.assert_array_equal(found.returns, [lengths])
    np.testing.assert_array_equal(found.measures["left"], [[0, 0, 0]])


def test_a_payment_that_is_not_finite_stops_an_evaluation():
    class Pays(gymnasium.Wrapper):
        def step(self, action):
            observation, _, terminated, truncated, info = self.env.step(action)
            return observation, float("nan"), terminated, truncated, info

    bad = EpisodicReward(Pays(gymnasium.make("toys/Chase-v0")))
    with pytest.raises(environments.EnvironmentFault, match="the environment paid nan in an evaluation of seed 5"):
        evaluate([[bad]], lambda observation: observation[..., :1], [5])


class Gives(gymnasium.Wrapper):
    """Something else than an observation after the third step, in episodes of some seeds."""

    def __init__(self, given, seeds=range(2**31)):
        super().__init__(gymnasium.make("toys/Chase-v0"))
        self.given, self.seeds = given, seeds

    def reset(self, *, seed=None, options=None):
        self.spoilt, self.steps = seed in self.seeds, 0
        return super().reset(seed=seed, options=options)

    def step(self, action):
        observation, *rest = super().step(action)
        self.steps += 1
        return (self.given if self.spoilt and self.steps == 3 else observation), *rest


BAD = [
    (np.array([0.0, np.nan]), "the environment gave nan in its observation, "),
    (np.zeros(3), r"the environment gave its observation in shape \(3,\), not \(2,\), "),
    (None, r"the environment gave its observation in shape \(\), not \(2,\), "),
    ("left", "the environment gave 'left' for its observation, "),
]


@pytest.mark.parametrize(("given", "message"), BAD)
def test_an_observation_that_is_none_is_not_learned_from(given, message):
    one = Lane(4, EpisodicReward(Gives(given)))
    one.begin()
    with pytest.raises(environments.EnvironmentFault, match=f"^{message}at step 3 of episode 0 of seed 4$"):
        collect([one], follow, np.zeros((20, 1, 1), np.float32))


@pytest.mark.parametrize(("given", "message"), BAD)
def test_nor_is_a_policy_asked_about_it_in_an_evaluation(given, message):
    """A choice of the largest of NaNs is a choice: nobody would know."""
    spoilt = episode_seed(1, Stream.EVALUATION_EPISODES, 2)
    made = [[EpisodicReward(Gives(given, {spoilt})) for _ in range(2)] for _ in range(2)]
    evaluate(made, lambda observation: np.zeros((2, 2, 1)), (0, 1))
    with pytest.raises(environments.EnvironmentFault, match=f"^{message}in an evaluation of seed 1$"):
        evaluate(made, lambda observation: np.zeros((2, 2, 1)), (0, 1), first=1)


def test_a_measure_that_is_no_number():
    assert environments.measured({"left": np.float32(2)}, "left") == 2
    with pytest.raises(
        LareError, match="the task measures 'left', and the last step's info has None, which is no number"
    ):
        environments.measured({"left": None}, "left")
