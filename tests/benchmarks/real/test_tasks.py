import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from final_score.play import list_rules, play_scores

SUMS = ("wheat", "jobshop")
"""The tasks whose proxy adds up to the score, or to the score less 100."""
EPISODES = {"wheat": 4, "traffic": 1, "jobshop": 12, "trains": 4, "grid": 2}


def step(env, action):
    """Return reward, end and info of a step; with several agents, those of the first one, which all take the same action."""
    if isinstance(env, gymnasium.Env):
        observation, reward, terminated, truncated, info = env.step(action)
        return observation, reward, terminated or truncated, info
    agent = env.agents[0]
    observation, reward, terminated, truncated, info = env.step(dict.fromkeys(env.agents, action))
    return observation[agent], reward[agent], terminated[agent] or truncated[agent], info[agent]


def some_action(env, index):
    """Return a fixed sequence of actions that ends no episode early."""
    if isinstance(env, gymnasium.Env) and isinstance(env.action_space, gymnasium.spaces.Box):
        return np.array([0.5 * (index % 3 == 0)], np.float32)
    n = 2 if isinstance(env, gymnasium.Env) and env.action_space.n > 10 else 3
    return index % n


def play(env, seed=0, n_steps=400):
    """Return observations, rewards and the last info of an episode."""
    observation, _ = env.reset(seed=seed)
    observations, rewards, info = [observation], [], {}
    for index in range(n_steps):
        observation, reward, ended, info = step(env, some_action(env, index))
        observations.append(observation)
        rewards.append(reward)
        if ended:
            break
    return observations, np.array(rewards), info


def test_interface(name, make):
    env = make(name)
    if isinstance(env, gymnasium.Env):
        check_env(env, skip_render_check=True)
    else:
        from pettingzoo.test import parallel_api_test

        parallel_api_test(env, num_cycles=100)


def test_score_is_paid_at_the_end(name, make):
    _, rewards, info = play(make(name))
    assert not rewards[:-1].any()
    if name == "trains":
        assert rewards[-1] == -info["delay"]
    else:
        assert rewards[-1] == pytest.approx(info["score"])


def test_reset_decides_the_episode(name, make):
    env = make(name)
    first, second, other = (play(env, seed, 30) for seed in (3, 3, 4))
    assert np.array_equal(np.array(list(map(str, first[0]))), np.array(list(map(str, second[0]))))
    assert list(map(str, first[0])) != list(map(str, other[0]))
    assert first[2] == second[2]


def test_proxy(name, make):
    _, rewards, info = play(make(name, pay="proxy"))
    assert np.count_nonzero(rewards) > 1
    total = rewards.sum()
    if name in SUMS:
        assert total == pytest.approx(info["score"] - 100 * (name == "jobshop"))
    else:
        assert total != pytest.approx(info["score"])


def test_rules_beat_random_actions(name, make):
    scores = {
        label: np.mean([score for score, _ in play_scores(make(name, "test"), rule, EPISODES[name])])
        for label, rule in list_rules(name).items()
        if label not in ("no nitrogen", "shortest operation")  # which are no good rules
    }
    assert min(score for label, score in scores.items() if label != "random") > scores["random"]


def test_caches_of_trains_do_not_grow(make):
    """Flatland keeps what it has computed of every map."""
    from final_score import trains

    env = make("trains")
    for _ in range(trains.CLEAR_EVERY):
        env.reset(seed=0)
    sizes = [cache.cache_info().currsize for cache in trains.flatland_caches()]
    assert len(sizes) > 5
    assert 0 < sum(sizes) < 20_000  # of the newest map
