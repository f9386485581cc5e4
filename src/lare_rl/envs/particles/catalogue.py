"""The particle tasks, by name."""

from lare_rl.envs.particles import navigation, predator_prey
from lare_rl.envs.particles.task import ParticleTask
from lare_rl.envs.particles.triangle_area import triangle_area
from lare_rl.errors import find_named

__all__ = ["TASKS", "find_particle_task"]

TASKS: dict[str, ParticleTask] = {
    task.name: task
    for task in (
        *map(navigation.navigation, navigation.SIZES),
        *map(predator_prey.predator_prey, predator_prey.SIZES),
        predator_prey.competitive(),
        triangle_area(),
    )
}


def find_particle_task(name: str) -> ParticleTask:
    """Return the task of a name. Raises `LareError` if no task has it."""
    return find_named("particle task", "particle tasks", name, TASKS)
