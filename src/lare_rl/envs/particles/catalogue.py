"""The particle tasks, by name."""

from lare_rl.envs.particles import navigation, predator_prey
from lare_rl.envs.particles.task import ParticleTask
from lare_rl.envs.particles.triangle_area import triangle_area
from lare_rl.errors import LareError, did_you_mean

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
    """Return the task of a name.

    Raises:
        LareError: no task has this name; the message lists all names.
    """
    if name in TASKS:
        return TASKS[name]
    raise LareError(f"no particle task {name!r}{did_you_mean(name, TASKS)}; the particle tasks are {', '.join(TASKS)}")
