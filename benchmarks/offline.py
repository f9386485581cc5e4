"""An offline learner on logged episodes: trained on true rewards, on the return at the end, and on rewards by `lare-rl relabel`.

    lare-rl train HalfCheetah-v4 --method dense --steps 60000 --evaluate-every 20000 --out RUN
    python benchmarks/offline.py RUN

The log has all 60 episodes of the run's training, from random actions on. `lare-rl relabel` sees only the return of each episode.
The learner is TD3+BC, `examples/offline_td3_bc.py`, with seeds 0 to 2 for each kind of rewards. The returns of all evaluations,
and how well the proxy rewards agree with the true ones, are written to results/offline.json.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
import torch

import lare_rl
from lare_rl.data import replay
from lare_rl.logs.open_log import open_log
from lare_rl.training.saved_state import load_learner
from lare_rl.training.seed_axis import select_seed
from measure import write

sys.path.append(str(Path(__file__).parents[1] / "examples"))
from offline_td3_bc import main as td3_bc

UPDATES, SEEDS = 50_000, (0, 1, 2)
METHODS = ("lare-bayes", "bayes")


def write_log(run: lare_rl.Run, out: Path) -> list[float]:
    """Write the training episodes of a run's first seed as .npz files with their scores. Returns the episodes' returns."""
    _, learner, host, _ = load_learner(run)
    buffer = select_seed(learner).replay
    steps = replay.read_newest(buffer, host["step"])
    observation, next_observation = (
        np.asarray(timestep["observation"])[0, :, 0] for timestep in (steps.columns, steps.next_columns)
    )
    action, reward = np.asarray(steps.columns["action"])[0, :, 0], np.asarray(steps.columns["reward"])[0, :, 0]
    length = int(np.asarray(steps.length).max())
    out.mkdir()
    for number, start in enumerate(range(0, len(observation), length)):
        rows = slice(start, start + length)
        np.savez(
            out / f"{number:03d}.npz",
            observations=np.concatenate([observation[rows], next_observation[rows][-1:]]),
            actions=action[rows],
            true_rewards=reward[rows],
            score=reward[rows].sum(dtype=np.float64),
        )
    return [float(reward[start : start + length].sum()) for start in range(0, len(observation), length)]


def agreement(log: Path) -> float:
    """The correlation of r_hat with the true rewards, over all steps."""
    episodes = [episode.contents for episode in open_log(log).episodes()]
    r_hat, true = (np.concatenate([episode[key] for episode in episodes]) for key in ("rewards", "true_rewards"))
    return float(np.corrcoef(r_hat, true)[0, 1])


def scores(log: Path, rewards: str, environment: str) -> list[list[float]]:
    """The returns of each seed, every 10,000 updates."""
    return [td3_bc(str(log), rewards, UPDATES, environment, seed) for seed in SEEDS]


def main(run: str) -> None:
    opened = lare_rl.open_run(run)
    task = opened.config.task
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log"
        returns = write_log(opened, log)
        results = {}
        for method in METHODS:
            out = Path(folder) / method
            phi = lare_rl.design(task) if method.startswith("lare-") else None
            outcome = lare_rl.relabel(log, out, method=method, phi=phi, task=task)
            results[method] = {"held-out R^2": outcome.return_r2, "correlation with true rewards": agreement(out)}
            results[method]["returns"] = scores(out, "rewards", task.environment)
        results["return at the end"] = {"returns": scores(log, "end", task.environment)}
        for file in log.glob("*.npz"):
            values = dict(np.load(file))
            np.savez(file, **{key: values[key] for key in ("observations", "actions")}, rewards=values["true_rewards"])
        results["true rewards"] = {"returns": scores(log, "paid", task.environment)}
    figures = {"task": task.name, "seeds": list(SEEDS), "updates": UPDATES, "returns of the log": returns}
    write("offline", {**figures, "rewards": results})


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(sys.argv[1])
