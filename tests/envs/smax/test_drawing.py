import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.patches import Circle

from helpers.fake_smac import compiled_smax
from lare_rl.envs.canvas import OTHER_COLOUR, TEAM_COLOUR, blank_figure
from lare_rl.envs.smax.battle import ATTACK, STOP, Battle
from lare_rl.envs.smax.drawing import find_hits, paint_state
from lare_rl.envs.smax.scenarios import SCENARIOS

SCENARIO = SCENARIOS["2s3z"]


def paint(battle, previous=None, credit=None):
    _, axes = blank_figure()
    paint_state(axes, SCENARIO, battle, previous, credit)
    return axes


@pytest.fixture(scope="module")
def battles() -> list[Battle]:
    """Our first stalker attacks the enemy's first for three steps. Two of the enemy's units are dead."""
    _, reset, step = compiled_smax("2s3z")
    state, _ = reset(jax.random.key(0))
    position = state.battle.position.at[0].set((14, 16)).at[5].set((18, 16))
    health = state.battle.health.at[jnp.array([8, 9])].set(0)
    states = [state._replace(battle=state.battle._replace(position=position, health=health))]
    action = np.eye(10, dtype=np.float32)[[ATTACK, STOP, STOP, STOP, STOP]]
    for number in range(3):
        states.append(step(states[-1], action, jax.random.key(number))[0])
    return [jax.tree.map(np.asarray, state.battle) for state in states]


def test_living_units_have_the_colours_of_their_sides(battles):
    circles = [patch for patch in paint(battles[0]).patches if isinstance(patch, Circle)]
    ally, enemy = (Circle((0, 0), edgecolor=colour).get_edgecolor() for colour in (TEAM_COLOUR, OTHER_COLOUR))
    assert [circle.get_edgecolor() for circle in circles] == [ally] * 5 + [enemy] * 3
    assert circles[0].radius == 0.625


def test_hits_are_drawn_in_their_step(battles):
    assert (0, 5) in find_hits(SCENARIO, battles[1], battles[0])
    # The action is still an attack, but the cooldown has not passed.
    assert (0, 5) not in find_hits(SCENARIO, battles[2], battles[1])
    n_lines = [len(paint(battles[1], previous).lines) for previous in (None, battles[0])]
    assert n_lines[0] < n_lines[1]
