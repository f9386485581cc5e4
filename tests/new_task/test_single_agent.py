"""First drafts of task files, of Gymnasium's own environments and of toys that document themselves badly."""

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box

from helpers.toy_envs import Chase
from lare_rl.envs.load import load_task
from lare_rl.errors import LareError
from lare_rl.latent.function import verify_function
from lare_rl.llm.prompts import candidate
from lare_rl.new_task.documentation import plain_lines, remove_rewards
from lare_rl.new_task.single_agent import draft_task
from lare_rl.tasks.spec import FILL_IN
from lare_rl.util.sanitize import one_line

SIZES = {
    "Pendulum-v1": (3, 1),
    "Ant-v5": (105, 8),
    "Pusher-v5": (23, 7),
    "CartPole-v1": (4, 2),
    "FrozenLake-v1": (16, 4),
    "Blackjack-v1": (45, 2),
}

CONSTANT = "def evaluation_func(observation, action):\n    return [observation[:, :1] + action[:, :1]]"


def load(tmp_path, text: str):
    (tmp_path / "task.toml").write_text(text)
    return load_task(tmp_path / "task.toml")


@pytest.mark.parametrize("name", SIZES)
def test_real_environments(tmp_path, name):
    draft = draft_task(name)
    assert draft.missing_keys == ()
    task = load(tmp_path, draft.toml)
    assert (task.name, task.environment) == (name, name)
    assert (task.observation_size, task.action_size) == SIZES[name]
    request = " ".join(message["content"] for message in candidate(task)[1:]).lower()
    assert "reward" not in request
    assert "penalt" not in request
    if name == "CartPole-v1":
        assert verify_function(CONSTANT, task).size == 1


class Told(Chase):
    """Tells of a chase.

    The goal is to catch the *target*. You get a reward of \alpha for each catch. See [the docs](https://x.y).

    ## Action Space
    | Num | Action | Reward |
    |-----|--------|--------|
    | 0   | guess `a` \\o/ ""\" | no cost |
    | 1   | The second row | - |

    ## Observation Space
    A target. It returns nothing.

    ## Rewards
    Secret.

    ## Episode End
    1. Truncation: after 20 steps.
    """


class Silent(gymnasium.Env):
    observation_space = Box(-1, 1, (2, 3), np.float32)
    action_space = Box(np.array([-1, -2], np.float32), np.array([1, 2], np.float32))

    def reset(self, *, seed=None, options=None):
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {}


gymnasium.register("toys/Told-v0", entry_point=Told, max_episode_steps=20)
gymnasium.register("toys/Silent-v0", entry_point=Silent, disable_env_checker=True)


def test_plain_lines():
    text = """
    | Num | Observation | Min | Max | Reward |
    |:---:|-------------|-----|-----|--------|
    | 0   | height      | 0   | 1   | none   |
    | 1   | speed       |     | 3   |        |
    The rest.
    | 2 | no head |
    0: floor
    1 to 2: waiting people,
    by floor
    """
    table = ["0: height; Min 0; Max 1; Reward none", "1: speed; Max 3", "The rest.", "2: no head"]
    assert plain_lines(text) == [*table, "0: floor", "1 to 2: waiting people, by floor"]


def test_rewards_are_removed(tmp_path):
    draft = draft_task("toys/Told-v0")
    task = load(tmp_path, draft.toml)
    assert task.description == (
        "Tells of a chase.\nThe goal is to catch the *target*.\nSee the docs.\n1. Truncation: after 20 steps."
    )
    assert task.observation == "2 entries.\nA target.\nIt returns nothing."
    assert task.action == '1 entry, between -2 and 2.\n0: guess a \\o/ """\n1: The second row'
    removed = (
        "You get a reward of \alpha for each catch.",
        '0: guess a \\o/ """; Reward no cost',
        "1: The second row; Reward -",
    )
    assert all(f"\n#   {one_line(text)}\n" in draft.toml for text in removed)
    assert "3 sentences or rows" in draft.toml
    assert "not used: rewards." in draft.toml


def test_undocumented_texts_are_marked(tmp_path):
    draft = draft_task("toys/Silent-v0")
    assert draft.missing_keys == ("description", "observation", "action")
    assert "Left out" not in draft.toml
    task = load(tmp_path, draft.toml)
    with pytest.raises(LareError, match=f"description still says '{FILL_IN}'"):
        candidate(task)
    assert (task.observation_size, task.action_size, task.max_episode_steps) == (6, 2, 1000)
    assert "max_episode_steps = 1000 # a guess" in draft.toml
    assert "\n# group = " in draft.toml
    assert task.observation.startswith("6 entries, an array of shape (2, 3) row by row.")


GOAL = "The goal is to run forward as fast as possible"


@pytest.mark.parametrize(
    ("sentence", "rest"),
    [
        ("The agent gets a reward of 1 for each step.", ""),
        ("You earn 5 points.", ""),
        ("It is worth +10 points.", ""),
        ("The goal is to maximise the expected return.", ""),
        ("Be quick, since a penalty is due.", ""),
        ("The agent gets a bonus of 10 for each apple.", ""),
        ("The fitness is the distance.", ""),
        ("A mark 0..100 at the end.", ""),
        ("The final grade (0 to 10) depends on the level.", ""),
        ("A fixed point in the plane.", "A fixed point in the plane."),
        ("Face cards have a point value of 10.", "Face cards have a point value of 10."),
        ("It returns to the start.", "It returns to the start."),
        ("Stop at the mark on the floor.", "Stop at the mark on the floor."),
        (f"{GOAL}, with a positive reward for the distance.", f"{GOAL}."),
    ],
)
def test_sentences_about_rewards_are_removed(sentence, rest):
    assert remove_rewards([sentence]) == (rest, () if rest == sentence else (sentence,))


def load_with_teams(tmp_path, draft):
    for name, text in draft.teams.items():
        (tmp_path / name).write_text(text)
    return load(tmp_path, draft.toml)


def test_one_team(tmp_path):
    draft = draft_task("pettingzoo/mpe2.simple_spread_v3:parallel_env")
    assert (draft.name, draft.missing_keys, draft.teams) == ("simple_spread_v3", (), {})
    task = load_with_teams(tmp_path, draft)
    assert (task.name, task.observation_size, task.action_size) == ("simple_spread_v3", 18, 5)
    assert task.description.endswith("agents must learn to cover all the landmarks while avoiding collisions.")
    assert task.observation.startswith("18 entries.\nAgent observations: [self_vel, self_pos")
    assert task.action.startswith("5 entries, all 0 but one: the action that is taken.\nAgent action space: [no_action")
    assert "3 sentences or rows" in draft.toml
    assert "\n#   More specifically, all agents are globally rewarded based on how far" in draft.toml
    assert "\n# arguments = { N = 3, local_ratio = 0.5, max_cycles = 25, " in draft.toml


def test_two_teams(tmp_path):
    draft = draft_task("pettingzoo/mpe2.simple_adversary_v3:parallel_env")
    assert (draft.name, draft.missing_keys) == ("simple_adversary_v3", ())
    assert list(draft.teams) == ["simple_adversary_v3-adversary.toml", "simple_adversary_v3-agent.toml"]
    task = load_with_teams(tmp_path, draft)
    adversary, agent = task.roles
    assert [(role.name, role.agents) for role in task.roles] == [
        ("adversary", ("adversary_[0-9]*",)),
        ("agent", ("agent_[0-9]*",)),
    ]
    assert adversary.observation == (
        "13 entries: 8 of adversary_0's own, then 2 zeros, then all 0 but one: which agent it is (adversary_0, agent_0, agent_1)."
        "\nAdversary observation space: [landmark_rel_position, other_agents_rel_positions]"
    )
    assert agent.observation.splitlines()[1].startswith("Agent observation space: [goal_rel_position")
    for role in task.roles:
        request = " ".join(message["content"] for message in candidate(role)[1:]).lower()
        assert "reward" not in request
