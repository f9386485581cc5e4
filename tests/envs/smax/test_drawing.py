import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.patches import Circle

from lare_rl.envs.smax.battle import ATTACK, STOP, Battle
from lare_rl.envs.smax.drawing import ALLY_COLOUR, ENEMY_COLOUR, draw_state, find_hits
from lare_rl.envs.smax.smax_env import SMAX, SmaxState


@pytest.fixture(scope="module")
def env() -> SMAX:
    return SMAX("2s3z")


@pytest.fixture(scope="module")
def played(env) -> SmaxState:
    """Our first stalker hits the enemy's first; two of the enemy's are dead."""
    state, _ = env.reset(jax.random.key(0))
    position = state.battle.position.at[0].set((14, 16)).at[5].set((18, 16))
    health = state.battle.health.at[jnp.array([8, 9])].set(0)
    states = [state._replace(battle=state.battle._replace(position=position, health=health))]
    for number in range(3):
        choice = jnp.full(5, STOP).at[0].set(ATTACK)
        states.append(jax.jit(env.step)(states[-1], jax.nn.one_hot(choice, 10), jax.random.key(number))[0])
    return jax.tree.map(lambda *leaves: np.stack(leaves), *states)


def at(states: SmaxState, step: int) -> Battle:
    return jax.tree.map(lambda leaf: leaf[step], states.battle)


def test_the_living_are_discs_in_the_colours_of_their_sides(env, played):
    figure = draw_state(env.scenario, at(played, 0))
    circles = [patch for patch in figure.axes[0].patches if isinstance(patch, Circle)]
    assert len(circles) == 8
    colours = [circle.get_edgecolor() for circle in circles]
    both = [Circle((0, 0), edgecolor=colour).get_edgecolor() for colour in (ALLY_COLOUR, ENEMY_COLOUR)]
    assert colours == [both[0]] * 5 + [both[1]] * 3
    assert circles[0].radius == 0.625


def test_a_shot_is_shown_in_the_step_that_it_was_fired_in(env, played):
    steps = [at(played, step) for step in range(4)]
    assert (0, 5) in find_hits(env.scenario, steps[1], steps[0])
    # It still chooses to attack, but its weapon is not ready.
    assert (0, 5) not in find_hits(env.scenario, steps[2], steps[1])
    assert len(draw_state(env.scenario, at(played, 1), at(played, 0)).axes[0].lines) > len(
        draw_state(env.scenario, at(played, 1)).axes[0].lines
    )


def test_the_credit_is_written_beside_the_step(env, played):
    texts = [text.get_text() for text in draw_state(env.scenario, at(played, 2), credit=0.25).axes[0].texts]
    assert texts[-1] == "step 2   credit 0.25"
    assert draw_state(env.scenario, at(played, 2)).axes[0].texts[-1].get_text() == "step 2"
