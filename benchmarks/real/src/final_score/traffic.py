"""Traffic: the phases of one signal during one hour. The mean delay of all trips is known at the end of the hour.

SUMO through sumo-rl, with the nets of RESCO (Ault and Sharon, NeurIPS Datasets and Benchmarks 2021). libsumo allows one simulation in
each process, so each environment has a process of its own.
"""

import os
from collections.abc import Callable
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from final_score.child import ChildEnv
from final_score.options import Pay, Policy, Split, check_option

__all__ = ["RULES", "Traffic"]

DAYS = {"train": tuple(range(40)), "test": tuple(range(40, 60))}
"""The days whose demand is played."""


class Traffic(ChildEnv):
    """One hour at one signal, 360 decisions of 10 s.

    Args:
        net: "ingolstadt1" (three phases) or "cologne1" (four).
        split: which days are played.
        pay: "end" pays minus the mean delay (s) at the end of the hour; "proxy" pays sumo-rl's own reward, the change of the waiting
            times. These differ: the proxy does not add up to the score, nor to a multiple of it.
        render_mode: "rgb_array" or None.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 6}  # noqa: RUF012

    def __init__(
        self, net: str = "ingolstadt1", split: Split = "train", pay: Pay = "end", render_mode: str | None = None
    ):
        arguments: dict[str, Any] = {
            "net": check_option("net", net, ("ingolstadt1", "cologne1")),
            "days": DAYS[check_option("split", split, ("train", "test"))],
            "pays_proxy": check_option("pay", pay, ("end", "proxy")) == "proxy",
            "render_mode": render_mode,
        }
        super().__init__("final_score.traffic_process:TrafficProcess", arguments, sumo_variables())


def sumo_variables() -> dict[str, str]:
    """Return the environment variables that sumo-rl needs. A SUMO_HOME that is set already stays."""
    spec = find_spec("sumo")
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError("the traffic task needs SUMO: pip install 'final-score-tasks[traffic]'")
    return {"LIBSUMO_AS_TRACI": "1", "SUMO_HOME": os.environ.get("SUMO_HOME", str(Path(spec.origin).parent))}


def fixed_cycle(env: gymnasium.Env) -> Policy:
    """30 s of green for each phase, in turn."""
    n_phases, steps = int(env.action_space.n), count()  # type: ignore[attr-defined]
    return lambda observation: next(steps) // 3 % n_phases


def longest_queue(env: gymnasium.Env) -> Policy:
    """Green for the phase whose lanes have the longest queues, with a switch only if they are clearly longer."""
    phase_lanes = env.unwrapped.read("phase_lanes").astype(float)  # type: ignore[attr-defined]
    n_phases, n_lanes = phase_lanes.shape

    def policy(observation: np.ndarray) -> int:
        phase = int(np.argmax(observation[:n_phases]))
        queues = phase_lanes @ observation[n_phases + 1 + n_lanes : n_phases + 1 + 2 * n_lanes]
        best = int(np.argmax(queues))
        return best if queues[best] > queues[phase] + 0.05 else phase

    return policy


RULES: dict[str, Callable[[gymnasium.Env], Policy]] = {"longest queue": longest_queue, "fixed cycle": fixed_cycle}
"""Rules of thumb by name. Make a new policy after each reset."""
