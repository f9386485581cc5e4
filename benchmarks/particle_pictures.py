"""The pictures of docs/reference/particle-tasks.md.

python benchmarks/particle_pictures.py
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

from lare_rl.envs.particles.catalogue import find_particle_task
from lare_rl.envs.particles.drawing import draw_frames

PICTURES = Path(__file__).parents[1] / "docs" / "pictures"


def main() -> None:
    for seed, name in enumerate(("CN-6", "PP-6", "CompetitivePP-6", "TriangleArea")):
        task = find_particle_task(name)
        # Some steps from the start, in which each agent keeps its direction.
        action = 1 + jnp.arange(task.n_agents) % 4
        state = task.reset(jax.random.key(seed))
        for key in jax.random.split(jax.random.key(seed), 6):
            state = task.step(state, action, key)
        (frame,) = draw_frames(task, np.asarray(state.position)[None])
        Image.fromarray(frame).resize((240, 240)).save(PICTURES / f"{name}.png")


if __name__ == "__main__":
    main()
