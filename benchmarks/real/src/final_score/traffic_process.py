"""The traffic task in the process that runs SUMO: `final_score.traffic` starts it.

It needs the environment variables SUMO_HOME and LIBSUMO_AS_TRACI when it is imported.
"""

import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import sumo_rl

from final_score.picture import new_figure, to_pixels

__all__ = ["TrafficProcess", "delays", "write_demand"]

NETS = {"cologne1": 25200, "ingolstadt1": 57600}
"""The nets of RESCO with one signal, and the second of the day at which their hour begins."""
HOUR = 3600
SECONDS_PER_STEP = 10


class TrafficProcess(gymnasium.Env):
    """One hour at one signal. See `final_score.traffic.Traffic`."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 6}  # noqa: RUF012

    def __init__(self, net: str, days: tuple[int, ...], pays_proxy: bool, render_mode: str | None = None):
        self._days, self._pays_proxy, self.render_mode = days, pays_proxy, render_mode
        self._folder = tempfile.TemporaryDirectory(prefix="final-score-")
        self._demand, self._trips = (Path(self._folder.name) / name for name in ("demand.rou.xml", "trips.xml"))
        self._begin = NETS[net]
        nets = Path(str(sumo_rl.__file__)).parent / "nets" / "RESCO" / net
        self._default_demand, self._net = nets / f"{net}.rou.xml", nets / f"{net}.net.xml"
        write_demand(self._default_demand, self._demand, days[0], self._begin)
        output = f"--no-step-log --tripinfo-output {self._trips}"
        unfinished = "--tripinfo-output.write-unfinished true --tripinfo-output.write-undeparted true"
        self._sumo: Any = sumo_rl.SumoEnvironment(
            net_file=str(self._net),
            route_file=str(self._demand),
            single_agent=True,
            begin_time=self._begin,
            num_seconds=HOUR,
            delta_time=SECONDS_PER_STEP,
            add_system_info=False,
            add_per_agent_info=False,
            sumo_warnings=False,
            sumo_seed=0,
            additional_sumo_cmd=f"{output} {unfinished}",
        )
        signal = self._signal
        size = self._sumo.observation_space.shape[0] + 1
        self.observation_space = gymnasium.spaces.Box(0.0, 1.0, (size,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(signal.num_green_phases)

    @property
    def phase_lanes(self) -> np.ndarray:
        """Whether a lane has green in a phase, phases x lanes. Only during an episode."""
        return green_lanes(self._signal)

    @property
    def _signal(self) -> Any:
        return self._sumo.traffic_signals[self._sumo.ts_ids[0]]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        day, sumo_seed = int(self.np_random.choice(self._days)), int(self.np_random.integers(1 << 30))
        self._day = int((options or {}).get("day", day))
        write_demand(self._default_demand, self._demand, self._day, self._begin)
        observation, _ = self._sumo.reset(seed=sumo_seed)
        self._n_steps, self._switched = 0, False
        return self._observe(observation), {"day": self._day}

    def step(self, action: Any):
        self._switched = self._signal.green_phase != int(action)
        observation, proxy, _, ended, _ = self._sumo.step(int(action))
        self._n_steps += 1
        score, info = 0.0, {"proxy": float(proxy)}
        if ended:
            self._sumo.close()
            seconds = delays(self._trips)
            score = -float(np.mean(seconds))
            info |= {
                "score": score,
                "trips": len(seconds),
                "longest_delay": float(np.max(seconds)),
                "day": self._day,
                "level": self._day,
            }
        reward = info["proxy"] if self._pays_proxy else score
        return self._observe(observation), reward, bool(ended), False, info

    def render(self):
        import sumolib

        figure, simulation = new_figure(5.0, 4.0), self._sumo.sumo
        axes = figure.subplots()
        for edge in sumolib.net.readNet(str(self._net)).getEdges():
            for lane in edge.getLanes():
                axes.plot(*np.array(lane.getShape()).T[:2], color="lightgrey", linewidth=2, zorder=1)
        names = simulation.vehicle.getIDList()
        positions = np.array([simulation.vehicle.getPosition(name) for name in names]).reshape(-1, 2)
        stopped = np.array([simulation.vehicle.getSpeed(name) < 0.1 for name in names], bool)
        for colour, rows in (("tab:green", ~stopped), ("tab:red", stopped)):
            axes.scatter(*positions[rows].T, s=9, color=colour, zorder=2)
        axes.set(aspect="equal", title=f"day {self._day}, {self._n_steps * SECONDS_PER_STEP} s")
        axes.axis("off")
        return to_pixels(figure)

    def close(self) -> None:
        self._sumo.close()
        self._folder.cleanup()

    def _observe(self, observation: np.ndarray) -> np.ndarray:
        entries = np.append(observation, self._n_steps * SECONDS_PER_STEP / HOUR)
        # sumo-rl says here whether the phase may be switched, which is so at every decision.
        entries[self._signal.num_green_phases] = self._switched
        return np.clip(entries, 0.0, 1.0).astype(np.float32)


def write_demand(trip_file: Path, file: Path, day: int, begin: int) -> None:
    """Write the trips of a day: 80 to 110% as many as in RESCO's hour, drawn from it with replacement, each some minutes earlier or
    later.
    """
    random = np.random.default_rng([48, day])
    root = ET.parse(trip_file).getroot()
    trips = root.findall("trip")
    for trip in trips:
        root.remove(trip)
    chosen = random.integers(len(trips), size=round(random.uniform(0.8, 1.1) * len(trips)))
    departures = np.array([float(trips[index].get("depart", "0")) for index in chosen])
    departures = begin + (departures + random.normal(0.0, 180.0, len(chosen)) - begin) % HOUR
    for number, row in enumerate(np.argsort(departures, kind="stable")):
        attributes = {**trips[chosen[row]].attrib, "id": str(number), "depart": f"{departures[row]:.2f}"}
        ET.SubElement(root, "trip", attributes)
    ET.ElementTree(root).write(file)


def delays(trips: Path) -> np.ndarray:
    """Return the delay of each trip of SUMO's file: the time that it lost on its way, and the time that it waited to enter the net.
    Trips that had not ended count with their delay until then.
    """
    root = ET.parse(trips).getroot()
    return np.array([float(trip.get("timeLoss", "0")) + float(trip.get("departDelay", "0")) for trip in root])


def green_lanes(signal: Any) -> np.ndarray:
    """Return whether a lane has green in a phase, phases x lanes."""
    links = signal.sumo.trafficlight.getControlledLinks(signal.id)
    matrix = np.zeros((signal.num_green_phases, len(signal.lanes)), bool)
    for phase_index, phase in enumerate(signal.green_phases):
        for light, link in zip(phase.state, links, strict=True):
            if link and light in "Gg":
                matrix[phase_index, signal.lanes.index(link[0][0])] = True
    return matrix
