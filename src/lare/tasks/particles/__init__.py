"""Multi-agent particle tasks in JAX: see `table.py` for all of them, `world.py` for their physics.

Only names stand here: who lists tasks, or verifies a function, need not wait for JAX.
"""

import gymnasium

NAMESPACE = "particles/"
"""What the environment of a particle task's spec begins with; the rest is its name in `table.py`."""

NAMES = ("CN-6", "CN-15", "CN-30", "PP-6", "PP-15", "PP-30", "CompetitivePP-6", "TriangleArea")
TEAMS = {"CompetitivePP-6": ("predator", "prey")}
"""Tasks in which more than one team learns; each team has a spec of its own, TASK-TEAM."""


def register() -> None:
    """Make every task known to Gymnasium as one of its agents meets it; a second call changes nothing."""
    views = {name: {"task": name} for name in NAMES} | {
        f"{name}-{team}": {"task": name, "team": place}
        for name, teams in TEAMS.items()
        for place, team in enumerate(teams)
    }
    for name, arguments in views.items():
        if NAMESPACE + name not in gymnasium.registry:
            entry_point = "lare.tasks.particles.one_agent:OneAgent"
            gymnasium.register(NAMESPACE + name, entry_point=entry_point, max_episode_steps=25, kwargs=arguments)
