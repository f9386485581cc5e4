"""The kept runs of the headline: tasks, methods, and the scores of their seeds."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lare_rl.compare.scores import last_quarter

RESULTS = Path(__file__).parent / "results"
Sources = Sequence[str]
"""Where the scores of a method are: directories of runs with the same seeds or others, or FILE.json:TABLE:LABEL of `scores.training`."""
Seeds = Float[np.ndarray, " seeds"]


@dataclass(frozen=True)
class Comparison:
    """A task, and the scores of each method."""

    steps: int
    episodic: Sources = ()
    dense: Sources = ()
    raw: Mapping[str, Sources] = field(default_factory=dict)
    """The candidates for the best decoder of raw features."""
    paper: Sources = ()
    default: Sources = ()
    without_phi: Sources = ()
    """The default's fit of raw entries, where it was trained. It is in the table only."""
    metric: str = "evaluation/return"
    averages_last_quarter: bool = True
    """Whether a score is the mean of the evaluations after three quarters of the steps, or that of the last one."""


LEARNING, SWEEP, GPU = "learning", "sweeps/closed-form", "closed-form-gpu"
LAPTOP, FULL, WHY = "reproduce/laptop", "sweeps/closed-form-full", "why"
PUBLISHED, WHOLE_EPISODE, OWN_DELAY = "-published", "-whole-episode", "-own-delay"
"""Endings of runs of `lare-rl reproduce real`: see `benchmarks/real/study.toml`."""


def long_particles(task: str) -> Comparison:
    """A particle task of the paper, with the published number of steps."""
    return Comparison(
        2_050_000,
        [f"{LAPTOP}/{task}/episodic-ippo"],
        [f"{LAPTOP}/{task}/dense-ippo"],
        {method: [f"{LAPTOP}/{task}/{method}-ippo"] for method in ("rd", "rrd", "arel", "stas")},
        [f"{LAPTOP}/{task}/lare-rd-ippo-draw0"],
        [f"{FULL}/{task}/lare-bayes-ippo-draw0"],
        metric="evaluation/summed_return",
        averages_last_quarter=False,
    )


def hidden(task: str) -> Comparison:
    """A score that the texts of the task do not describe."""
    return Comparison(
        60_000,
        raw={"rrdu": [f"{LAPTOP}/{task}/rrdu-td3", f"{WHY}/{task}/rrdu-on-a-gpu"]},
        paper=[f"{LAPTOP}/{task}/lare-rrdu-td3-draw0", f"{WHY}/{task}/lare-rrdu-on-a-gpu"],
        default=[f"{LAPTOP}/{task}/lare-bayes-td3-draw0", f"{GPU}/{task}/lare-bayes"],
        averages_last_quarter=False,
    )


def simulator_runs(task: str, algorithm: str, method: str, ending: str = "") -> Sources:
    """The runs of a method on a simulator: seeds 0 to 4, and 5 to 9."""
    environment = f"{task}Proxy" if method == "dense" and ending != OWN_DELAY else task
    return [f"{LAPTOP}/real/seeds-{first}/{environment}/{method}-{algorithm}{ending}" for first in (0, 5)]


def simulator(task: str, algorithm: str, steps: int, episodic: str = "", dense: str = "") -> Comparison:
    """A simulator whose score exists only at the end. A dense proxy of the score takes the place of true rewards.

    Args:
        episodic, dense: the endings of the runs of the two references. They name the setting with the highest scores.
    """
    return Comparison(
        steps,
        simulator_runs(task, algorithm, "episodic", episodic),
        simulator_runs(task, algorithm, "dense", dense),
        {"rrdu": simulator_runs(task, algorithm, "rrdu")},
        simulator_runs(task, algorithm, "lare-rrdu", PUBLISHED),
        simulator_runs(task, algorithm, "lare-bayes"),
        simulator_runs(task, algorithm, "bayes"),
        averages_last_quarter=False,  # evaluations have many episodes
    )


def sweep(
    study: str, task: str, *raw: str, algorithm: str = "td3", steps: int = 30_000, paper: str = "lare-rrdu"
) -> Comparison:
    """A task of a sweep, and its candidates for the best decoder of raw features."""

    def runs(method: str) -> Sources:
        return [f"sweeps/{study}/{task}/{method}-{algorithm}{'-draw0' if method.startswith('lare-') else ''}"]

    return Comparison(
        steps,
        runs("episodic"),
        runs("dense"),
        {method: runs(method) for method in raw},
        runs(paper),
        runs("lare-bayes"),
        runs("bayes"),
    )


def score_study(sources: str, steps: int, *raw: str, paper: str = "lare-rrdu", without_phi: bool = True) -> Comparison:
    """A study of `scores.training`. Its methods' runs, or its tables, are at `sources` with the label of the method."""

    def labelled(label: str) -> Sources:
        return [f"{sources}{label}"]

    return Comparison(
        steps,
        labelled("episodic"),
        labelled("dense"),
        {method: labelled(method) for method in raw},
        labelled(paper),
        labelled("lare-bayes"),
        labelled("bayes") if without_phi else (),
    )


HALF_CHEETAH, WALKER = "HalfCheetah-v4", "Walker2d-v4"
COMPARISONS = {
    "wheat, SAC": simulator("Wheat", "sac", 6_000),
    "traffic, PPO": simulator("Traffic", "ppo", 36_000, WHOLE_EPISODE),
    "job shop, PPO": simulator("JobShop", "ppo", 100_000, WHOLE_EPISODE, WHOLE_EPISODE),
    "power grid, PPO": simulator("Grid", "ppo", 30_720),
    "trains, IPPO": simulator("Trains", "ippo", 60_000),
    f"{HALF_CHEETAH}, TD3": score_study(
        f"scores/cheetah/{HALF_CHEETAH},paidonce/", 30_000, "rrdu", "lrr", "grd", "rudder"
    ),
    f"{WALKER}, TD3": sweep("published", WALKER, "rrdu", "lrr", "grd", "rudder"),
    "Hopper-v5, TD3": sweep("unseen", "Hopper-v5", "rrdu", "lrr"),
    "Ant-v5, TD3": sweep("unseen", "Ant-v5", "rrdu", "lrr"),
    "Reacher-v4, TD3": sweep("headline", "Reacher-v4", "rrdu"),
    "HalfCheetahTarget-v4, TD3": sweep("headline", "HalfCheetahTarget-v4", "rrdu"),
    "HalfCheetahThreshold-v4, TD3": score_study(
        "scores/threshold/HalfCheetahThreshold-v4/", 60_000, "rrdu", without_phi=False
    ),
    "PP-6, IPPO": score_study("scores_published.json:PP-6, late:", 205_000, "rrdu", "lrr", paper="lare-rd"),
    "CN-6, IPPO": score_study("scores_published.json:CN-6, late:", 205_000, "rrdu", "lrr", paper="lare-rd"),
    "SMAX-2s3z, QMIX": sweep(
        "headline-starcraft", "SMAX-2s3z", "rrdu", algorithm="qmix", steps=200_000, paper="lare-rd"
    ),
}
"""Ten seeds for each method."""

THREE_SEEDS = {
    f"{HALF_CHEETAH}, TD3": Comparison(
        100_000,
        [f"{LEARNING}/{HALF_CHEETAH}/episodic"],
        [f"{LEARNING}/{HALF_CHEETAH}/dense", f"{SWEEP}/{HALF_CHEETAH}/dense-td3", f"{GPU}/{HALF_CHEETAH}/dense"],
        {
            "rrdu": [f"{LEARNING}/{HALF_CHEETAH}/rrdu"],
            "rd": [f"{LEARNING}/{HALF_CHEETAH}/rd"],
            "rrd": [f"{SWEEP}/{HALF_CHEETAH}/rrd-td3"],
        },
        [
            f"{LEARNING}/{HALF_CHEETAH}/lare-rrdu",
            f"{SWEEP}/{HALF_CHEETAH}/lare-rrdu-td3-draw0",
            f"{GPU}/{HALF_CHEETAH}/lare-rrdu",
        ],
        [f"{SWEEP}/{HALF_CHEETAH}/lare-bayes-td3-draw0", f"{GPU}/{HALF_CHEETAH}/lare-bayes"],
        [f"{GPU}/{HALF_CHEETAH}/bayes"],
        averages_last_quarter=False,
    ),
    **{f"{task}, IPPO": long_particles(task) for task in ("PP-6", "CN-6", "TriangleArea")},
    "SMAX-2s3z, QMIX": Comparison(
        200_000,
        [f"{LAPTOP}/SMAX-2s3z/episodic-qmix"],
        [f"{LAPTOP}/SMAX-2s3z/dense-qmix"],
        {method: [f"{LAPTOP}/SMAX-2s3z/{method}-qmix"] for method in ("rd", "rrd", "rrdu")},
        [f"{LAPTOP}/SMAX-2s3z/lare-rd-qmix-draw0"],
        metric="evaluation/won",
        averages_last_quarter=False,
    ),
    "HalfCheetahFoot-v4, TD3": hidden("HalfCheetahFoot-v4"),
    "HalfCheetahSaturating-v4, TD3": hidden("HalfCheetahSaturating-v4"),
}
"""They are in no picture and in no mean. Three seeds do not rank methods that are close."""


def read_scores(sources: Sources, comparison: Comparison) -> dict[int, list[float]]:
    """The scores of each seed, one for each run."""
    scores: dict[int, list[float]] = {}
    for source in sources:
        file, _, table = source.partition(":")
        if table:
            results = json.loads((RESULTS / file).read_text())
            label, _, method = table.partition(":")
            values = dict(zip(results["seeds"], results["tables"][label][method]["returns"], strict=True))
        else:
            values = read_run(source, comparison)
        for seed, score in values.items():
            scores.setdefault(seed, []).append(score)
    return scores


def read_run(directory: str, comparison: Comparison) -> dict[int, float]:
    """The score of each seed of a run."""
    lines = [json.loads(line) for line in (RESULTS / directory / "metrics.jsonl").read_text().splitlines()]
    steps = sorted({line["step"] for line in lines if line["step"] <= comparison.steps})
    if not steps or steps[-1] != comparison.steps:
        raise SystemExit(f"{directory} has no step {comparison.steps}")
    steps = last_quarter(steps) if comparison.averages_last_quarter else steps[-1:]
    values: dict[int, list[float]] = {}
    for line in lines:
        if line["step"] in steps:
            values.setdefault(line["seed"], []).append(line[comparison.metric])
    return {seed: float(np.mean(returns)) for seed, returns in values.items()}


def seed_means(sources: Sources, comparison: Comparison) -> Seeds:
    scores = read_scores(sources, comparison)
    return np.array([np.mean(scores[seed]) for seed in sorted(scores)])
