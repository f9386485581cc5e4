"""Power grid: the topology of a small grid during one day. The energy that did not reach the customers is known at the end of the day.

Grid2Op with its grid `rte_case5_example`: 5 substations, 8 lines, 20 weeks of load and generation. A line that is overloaded for more
than two steps is disconnected, and a blackout ends the day.
"""

import functools
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from final_score.options import Pay, Policy, Split, check_option
from final_score.picture import new_figure, to_pixels

__all__ = ["RULES", "Grid", "day_energy"]

STEPS = 288
"""Steps of a day, of 5 minutes."""
N_DAYS = 6
WEEKS = {
    "train": tuple(week for week in range(20) if week % 10 not in (1, 4, 7)),
    "test": tuple(week for week in range(20) if week % 10 in (1, 4, 7)),
}
HOURS_PER_STEP = 1 / 12
STEPS_PER_DECISION = 6
LOADED = 0.9
"""The loading of a line above which the rule acts."""
SAFE = (
    *(1, 2, 3, 6, 7, 8, 10, 11, 14, 15, 16, 18, 19, 20, 22, 23, 24, 26, 27, 28, 30, 33, 34, 35, 38, 39, 40, 41),
    *(42, 43, 44, 45, 46, 47, 48, 49, 50, 51, 53, 54, 55, 56, 57, 58),
)
"""The configurations of a substation that may be chosen, by their number in Grid2Op's list of 58, from 1: those that end in no blackout
within five minutes, at 0:00 and 8:20 of the first day of the training weeks, in at least nine of ten cases.
"""
POWER = 20.0
"""Powers are observed divided by this (MW)."""


class Grid(gymnasium.Env):
    """One day, a decision every half an hour.

    Args:
        split: which weeks are played.
        pay: "end" pays minus the share (%) of the energy of the day that was lost on the lines or not served after a blackout; "proxy"
            pays the mean free capacity of the lines in each step. It does not add up to the score.
        render_mode: "rgb_array" or None.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 6}  # noqa: RUF012

    def __init__(self, split: Split = "train", pay: Pay = "end", render_mode: str | None = None):
        self._weeks = WEEKS[check_option("split", split, ("train", "test"))]
        self._pays_proxy = check_option("pay", pay, ("end", "proxy")) == "proxy"
        self.render_mode = render_mode
        self.grid = make_grid()
        """Grid2Op's environment."""
        self.grid_actions = list_actions(self.grid)
        """Grid2Op's action for each of our actions."""
        self.grid_observation: Any = None
        self.observation_space = gymnasium.spaces.Box(
            -1.0, 3.0, (4 * self.grid.n_line + self.grid.dim_topo + 7,), np.float32
        )
        self.action_space = gymnasium.spaces.Discrete(len(self.grid_actions))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin a day. `options={"week": 3, "day": 0}` chooses it."""
        super().reset(seed=seed)
        week, day = int(self.np_random.choice(self._weeks)), int(self.np_random.integers(N_DAYS))
        self._week, self._day = int((options or {}).get("week", week)), int((options or {}).get("day", day))
        begin = {"init ts": self._day * STEPS} if self._day else {}
        self.grid_observation = self.grid.reset(seed=0, options={"time serie id": self._week, **begin})
        self._energy = day_energy(self._week, self._day)
        self._n_steps, self._losses, self._served = 0, 0.0, 0.0
        return self._observe(), {"week": self._week, "day": self._day}

    def step(self, action: Any):
        """Change the topology, and let half an hour pass."""
        capacity = 0.0
        blackout = self._pass_time(self.grid_actions[int(action)])
        while not blackout:
            capacity += float(np.mean(np.clip(1 - self.grid_observation.rho, 0.0, 1.0)))
            if self._n_steps % STEPS_PER_DECISION == 0:
                break
            blackout = self._pass_time(self.grid_actions[0])
        proxy = capacity / STEPS_PER_DECISION
        terminated = bool(blackout) or self._n_steps == STEPS
        info: dict[str, Any] = {"proxy": proxy}
        score = 0.0
        if terminated:
            unserved = self._energy - self._served
            score = -100 * (self._losses + unserved) / self._energy
            info |= {
                "score": score,
                "losses": self._losses,
                "unserved": unserved,
                "survived": (self._n_steps - bool(blackout)) / STEPS,
                "week": self._week,
                "day": self._day,
                "level": self._week,
            }
        return self._observe(), proxy if self._pays_proxy else score, terminated, False, info

    def _pass_time(self, action: Any) -> bool:
        """Let five minutes pass. Return whether they ended in a blackout."""
        self.grid_observation, _, blackout, _ = self.grid.step(action)
        self._n_steps += 1
        if not blackout:
            load = float(self.grid_observation.load_p.sum())
            self._losses += (float(self.grid_observation.gen_p.sum()) - load) * HOURS_PER_STEP
            self._served += load * HOURS_PER_STEP
        return bool(blackout)

    def render(self):
        """Draw the grid. The colour of a line is its loading; a dashed line is disconnected."""
        figure = new_figure(4.5, 3.2)
        axes, grid, observation = figure.subplots(), self.grid, self.grid_observation
        positions = np.array([grid.grid_layout[name] for name in grid.name_sub])
        for line in range(grid.n_line):
            ends = positions[[grid.line_or_to_subid[line], grid.line_ex_to_subid[line]]]
            ends = ends + 6 * (
                sum(map(ord, grid.name_line[line])) % 3 - 1
            )  # parallel lines are drawn beside each other
            loading = float(observation.rho[line])
            colour = "tab:red" if loading > 1 else "tab:orange" if loading > 0.8 else "tab:green"
            style = "-" if observation.line_status[line] else ":"
            axes.plot(*ends.T, color=colour, linewidth=1 + 2 * loading, linestyle=style)
            x, y = ends.mean(axis=0).tolist()
            axes.text(x, y, f"{100 * loading:.0f}%", fontsize=7)
        axes.scatter(*positions.T, s=160, color="tab:blue", zorder=3)
        axes.set(title=f"week {self._week}, day {self._day}, {self._n_steps * HOURS_PER_STEP:.1f} h", aspect="equal")
        axes.axis("off")
        return to_pixels(figure)

    def close(self) -> None:
        """Close Grid2Op's environment."""
        self.grid.close()

    def _observe(self) -> np.ndarray:
        observation = self.grid_observation
        hour = 2 * np.pi * self._n_steps / STEPS
        entries = np.concatenate(
            [
                observation.rho,
                observation.line_status,
                observation.timestep_overflow / 2,
                observation.time_before_cooldown_line / 10,
                observation.topo_vect - 1,
                observation.gen_p / POWER,
                observation.load_p / POWER,
                [np.sin(hour), np.cos(hour)],
            ]
        )
        return np.clip(np.nan_to_num(entries), -1.0, 3.0).astype(np.float32)


def make_grid() -> Any:
    """Return Grid2Op's environment."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import grid2op
        from lightsim2grid import LightSimBackend

        return grid2op.make("rte_case5_example", test=True, backend=LightSimBackend())


def list_actions(grid: Any) -> list[Any]:
    """Return the actions: nothing, one configuration of a substation, or a line that is connected again."""
    space = grid.action_space
    lines = [space({"set_line_status": [(line, 1)]}) for line in range(grid.n_line)]
    configurations = space.get_all_unitary_topologies_set(space)
    return [space({}), *(configurations[number - 1] for number in SAFE), *lines]


@functools.cache
def loads(week: int) -> np.ndarray:
    """Return the load of the grid in each step of a week (MW)."""
    import grid2op
    import pandas

    folder = Path(str(grid2op.__file__)).parent / "data" / "rte_case5_example" / "chronics" / f"{week:02}"
    return pandas.read_csv(folder / "load_p.csv.bz2", sep=";").to_numpy().sum(axis=1)


def day_energy(week: int, day: int) -> float:
    """Return the energy that the customers ask for in a day (MWh). The first row of the data is the state before the first step."""
    return float(loads(week)[day * STEPS + 1 : (day + 1) * STEPS + 1].sum() * HOURS_PER_STEP)


def do_nothing(env: gymnasium.Env) -> Policy:
    """Leave the grid as it is."""
    return lambda observation: 0


def simulate_if_loaded(env: gymnasium.Env) -> Policy:
    """If a line is loaded above 90%, simulate all actions by one step, and do the one with the smallest largest loading."""
    task = env.unwrapped
    assert isinstance(task, Grid)

    def policy(observation: np.ndarray) -> int:
        if (
            observation[: task.grid.n_line].max() < LOADED
            and observation[task.grid.n_line : 2 * task.grid.n_line].all()
        ):
            return 0
        loadings = []
        for action in task.grid_actions:
            forecast, _, ended, _ = task.grid_observation.simulate(action)
            loadings.append(np.inf if ended else float(forecast.rho.max()))
        return int(np.argmin(loadings))

    return policy


RULES: dict[str, Callable[[gymnasium.Env], Policy]] = {
    "simulate if loaded": simulate_if_loaded,
    "do nothing": do_nothing,
}
"""Rules of thumb by name. The first one asks the simulator what an action would do, which no other policy here can."""
