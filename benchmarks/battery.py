"""What pairs of raw entries bring: a task whose best action depends on the state only through a product.

    python benchmarks/battery.py OUT

A battery buys and sells at a price that changes during the day: r = -price * power - 0.02 power^2. `bayes` is trained with pairs of
raw entries and without them, beside true rewards and the return at the end of an episode. A battery that does nothing scores 0.
Runs that OUT already holds are not trained again. "potential" is the regression of the last proxy rewards of `bayes` on the true
rewards and on the differences, from step to step, of all squares and products of the state's entries: the weight of the true
rewards and the correlation with the regression, for each seed.
"""

import sys
from pathlib import Path

import gymnasium
import numpy as np
from gymnasium.spaces import Box

import lare_rl
from lare_rl.algorithms.sac import SACSettings
from lare_rl.credit import basis
from lare_rl.data import replay
from lare_rl.training.rewards import rewards
from lare_rl.training.saved_state import load_learner
from lare_rl.training.seed_axis import select_seed
from measure import write

STEPS, WARMUP, SEEDS = 10_000, 2_000, 5
RECENT_STEPS = 2000
HALF_HOURS = 96
CAPACITY = 10.0
ROWS = {
    "true rewards": ("dense", basis.MAX_PAIRED_RAW_FEATURES),
    "bayes": ("bayes", basis.MAX_PAIRED_RAW_FEATURES),
    "bayes without pairs": ("bayes", 0),
    "rrdu": ("rrdu", basis.MAX_PAIRED_RAW_FEATURES),
    "return at the end": ("episodic", basis.MAX_PAIRED_RAW_FEATURES),
}
"""For each row, its method and the largest number of entries that get pairs."""

KEYS = "evaluation/return", "credit/correlation", "credit/return_r2"


class Battery(gymnasium.Env):
    """Two days in half hours: the observation is the price, the charge (0 to 1), and sine and cosine of the time of day."""

    observation_space = Box(-np.inf, np.inf, (4,), np.float32)
    action_space = Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.charge, self.drift, self.shift = 0, CAPACITY / 2, 0.0, self.np_random.normal()
        return self.observe(), {}

    def observe(self) -> np.ndarray:
        day = 2 * np.pi * self.t / 48
        self.price = 1 + 0.5 * np.sin(day + 0.3 * self.shift) + self.drift
        return np.array([self.price, self.charge / CAPACITY, np.sin(day), np.cos(day)], np.float32)

    def step(self, action):
        power = float(np.clip(action[0], -self.charge, CAPACITY - self.charge))
        reward = -self.price * power - 0.02 * power**2
        self.charge += power
        self.drift += 0.04 * self.np_random.normal()
        self.t += 1
        return self.observe(), reward, False, False, {}


def make(**kwargs: object) -> gymnasium.Env:
    return Battery(**kwargs)


gymnasium.register("benchmarks/Battery-v0", entry_point=make, max_episode_steps=HALF_HOURS)


def task() -> lare_rl.TaskSpec:
    """The task without texts for a language model: no row has a `phi`."""
    return lare_rl.TaskSpec(
        name="Battery",
        environment="benchmarks/Battery-v0",
        observation_size=4,
        action_size=1,
        description="Buy and sell electricity at a price that changes.",
        observation="0: price. 1: charge. 2: sine of the time of day. 3: cosine of the time of day.",
        action="0: power.",
    )


def beside_a_potential(run: lare_rl.Run) -> list[dict[str, float]]:
    """How far the proxy rewards of each seed are the true rewards plus the difference of a quadratic function of the state."""
    config, learner, _, _ = load_learner(run)
    results = []
    for seed_index in range(len(run.seeds)):
        i = select_seed(learner, seed_index)
        steps = replay.read_newest(i.replay, RECENT_STEPS)
        r_hat = np.asarray(rewards(steps, i.decoders, config))[0, :, 0]
        before, after = (
            np.asarray(timestep["observation"])[0, :, 0] for timestep in (steps.columns, steps.next_columns)
        )
        true, inside = np.asarray(steps.columns["reward"])[0, :, 0], ~np.asarray(steps.last)[0]
        change = quadratic(after) - quadratic(before)
        regressors = np.column_stack([true, change, np.ones(len(true))])[inside]
        weight = np.linalg.lstsq(regressors, r_hat[inside], rcond=None)[0]
        correlation = np.corrcoef(regressors @ weight, r_hat[inside])[0, 1]
        results.append({"weight": round(float(weight[0]), 3), "correlation": round(float(correlation), 3)})
    return results


def quadratic(state: np.ndarray) -> np.ndarray:
    """The entries of states, and all their squares and products."""
    i, j = np.triu_indices(state.shape[1])
    return np.column_stack([state, state[:, i] * state[:, j]])


def main(out: str) -> None:
    table = {}
    for name, (method, most) in ROWS.items():
        basis.MAX_PAIRED_RAW_FEATURES = most
        settings = lare_rl.Settings(
            method=method,
            algorithm="sac",
            steps=STEPS,
            seeds=SEEDS,
            evaluate_every=STEPS // 10,
            sac=SACSettings(warmup=WARMUP, target_every=2),
        )
        seed_index = Path(out) / name.replace(" ", "-")
        run = (
            lare_rl.open_run(seed_index)
            if seed_index.exists()
            else lare_rl.train(task(), settings, out=seed_index, listeners=[])
        )
        last = [line for line in run.metrics() if line["step"] == STEPS]
        table[name] = {key: [line[key] for line in last] for key in KEYS if key in last[0]}
        for key, values in table[name].items():
            print(f"{name:20s} {key:20s} {np.mean(values):8.3f} ± {np.std(values, ddof=1):.3f}", flush=True)
    basis.MAX_PAIRED_RAW_FEATURES = ROWS["bayes"][1]
    potential = beside_a_potential(lare_rl.open_run(Path(out) / "bayes"))
    print(potential)
    write("battery", {"steps": STEPS, "warmup": WARMUP, "algorithm": "sac", "rows": table, "potential": potential})


if __name__ == "__main__":
    main(sys.argv[1])
