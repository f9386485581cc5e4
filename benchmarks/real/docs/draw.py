"""Draw the picture of each task in the middle of an episode: `python benchmarks/real/docs/draw.py`."""

import sys
import warnings
from pathlib import Path

from matplotlib.image import imsave

from final_score.play import list_rules, make_task

SEEDS_AND_STEPS = {"wheat": (1, 19), "traffic": (0, 60), "jobshop": (0, 18), "trains": (7, 12), "grid": (1, 20)}


def main() -> None:
    """Write the pictures beside this file."""
    folder = Path(__file__).parent / "pictures"
    folder.mkdir(exist_ok=True)
    warnings.simplefilter("ignore")
    for name in sys.argv[1:] or SEEDS_AND_STEPS:
        seed, steps = SEEDS_AND_STEPS[name]
        env = make_task(name, "train", render_mode="rgb_array")
        observation, _ = env.reset(seed=seed)
        policy = list(list_rules(name).values())[2 if name == "traffic" else 1](env)
        for _ in range(steps):
            if name == "trains":
                observation = env.step({agent: policy(observation[agent]) for agent in env.agents})[0]
            else:
                observation = env.step(policy(observation))[0]
        imsave(folder / f"{name}.png", env.render())
        env.close()


if __name__ == "__main__":
    main()
