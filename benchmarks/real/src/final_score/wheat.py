"""Wheat: how much nitrogen to spread on spring wheat in each week of a season. The margin is known at harvest.

The crop is LINTUL3 (Shibu et al., European Journal of Agronomy 2010) in PCSE, with the crop, soil, site and weather data that
PCSE brings for its tests: the Dutch station NL1, 22 complete years.
"""

import datetime
import functools
import logging
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from final_score.options import Pay, Policy, Split, check_option
from final_score.picture import new_figure, to_pixels

__all__ = ["RULES", "Wheat", "find_years"]

MAX_DOSE = 60.0
"""kg of nitrogen for each hectare and week."""
SMALLEST_DOSE = 3.0
"""A smaller dose is no pass of the spreader (kg/ha)."""
RECOVERY = 0.7
"""The share of the nitrogen that the soil keeps for the crop, as in PCSE's example."""
GRAIN_PRICE, NITROGEN_PRICE, PASS_PRICE = 0.2, 1.2, 8.0
"""EUR for each kg of grain, for each kg of nitrogen, and for each hectare and pass."""
UNIT = 100.0
"""EUR/ha of a score of 1."""
MAX_WEEKS = 30
FIRST_LEVEL = 1970
"""The level of a season is its year less this one."""
EMERGENCE = (3, 31)
STATES = {"DVS": 2.0, "LAI": 6.0, "ANLV": 6.0, "ANST": 3.0, "TNSOIL": 20.0}
"""Variables of LINTUL3 that are observed, and the numbers that they are divided by: development stage, leaf area (m²/m²), nitrogen
in leaves, in stems, and in the soil (g/m²)."""


class Wheat(gymnasium.Env):
    """One season of spring wheat, one decision a week.

    Args:
        split: which years are played. Every third year is a test year.
        pay: "end" pays the margin at harvest; "proxy" pays the value of the grain that has grown in a week less the week's costs.
            These add up to the margin.
        render_mode: "rgb_array" or None.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012

    def __init__(self, split: Split = "train", pay: Pay = "end", render_mode: str | None = None):
        self._years = find_years(check_option("split", split, ("train", "test")))
        self._pays_proxy = check_option("pay", pay, ("end", "proxy")) == "proxy"
        self.render_mode = render_mode
        self.observation_space = gymnasium.spaces.Box(0.0, 3.0, (9,), np.float32)
        self.action_space = gymnasium.spaces.Box(0.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin a season. `options={"year": 1984}` chooses the year."""
        super().reset(seed=seed)
        year = int(self.np_random.choice(self._years))
        self._year = int((options or {}).get("year", year))
        self._model = start_crop(self._year)
        self._values = dict.fromkeys((*STATES, "WSO"), 0.0)
        self._week, self._passes, self._nitrogen = 0, 0, 0.0
        self._history: list[tuple[float, float, float]] = []
        self._read_model()
        return self._observe(), {"year": self._year}

    def step(self, action: Any):
        """Spread nitrogen, and let a week pass."""
        dose = MAX_DOSE * float(np.clip(np.asarray(action).reshape(-1)[0], 0.0, 1.0))
        dose = dose if dose >= SMALLEST_DOSE else 0.0
        if dose:
            spread(self._model, dose / 10)
        before = self._margin()
        self._nitrogen += dose
        self._passes += dose > 0
        self._week += 1
        self._model.run(days=7)
        self._read_model()
        self._history.append((self._values["LAI"], self._values["WSO"] / 100, dose))
        terminated = bool(self._model.flag_terminate) or self._week >= MAX_WEEKS
        proxy, score = self._margin() - before, self._margin()
        info: dict[str, Any] = {"proxy": proxy}
        if terminated:
            info |= {
                "score": score,
                "grain": self._grain(),
                "nitrogen": self._nitrogen,
                "passes": self._passes,
                "year": self._year,
                "level": self._year - FIRST_LEVEL,
            }
        reward = proxy if self._pays_proxy else score if terminated else 0.0
        return self._observe(), float(reward), terminated, False, info

    def render(self):
        """Draw leaf area, grain and the nitrogen of the season so far."""
        figure = new_figure()
        axes = figure.subplots()
        weeks = np.arange(1, len(self._history) + 1)
        leaves, grain, doses = np.array(self._history).reshape(-1, 3).T
        axes.plot(weeks, leaves, color="tab:green", label="leaf area (m²/m²)")
        axes.plot(weeks, grain, color="tab:orange", label="grain (t/ha)")
        axes.bar(weeks, doses / 10, color="tab:blue", alpha=0.5, label="nitrogen (10 kg/ha)")
        axes.set(xlim=(0, 22), ylim=(0, 8.5), xlabel=f"week after emergence, {self._year}")
        axes.legend(loc="upper left", fontsize=8)
        return to_pixels(figure)

    def _grain(self) -> float:
        """Return the grain (kg/ha)."""
        return 10 * self._values["WSO"]

    def _margin(self) -> float:
        costs = NITROGEN_PRICE * self._nitrogen + PASS_PRICE * self._passes
        return (GRAIN_PRICE * self._grain() - costs) / UNIT

    def _read_model(self) -> None:
        """Read the variables of the crop. A crop that was harvested during the week has none: its last grain is in the output, and the
        other variables stay.
        """
        for name in self._values:
            if (value := self._model.get_variable(name)) is not None:
                self._values[name] = float(value)
        if self._model.flag_terminate:
            self._values["WSO"] = max(day["WSO"] or 0.0 for day in self._model.get_output())

    def _observe(self) -> np.ndarray:
        week = [weather()(self._model.day - datetime.timedelta(days=days)) for days in range(7)]
        entries = [
            self._week / 20,
            *(self._values[name] / scale for name, scale in STATES.items()),
            self._nitrogen / 300,
            max(0.0, float(np.mean([day.TEMP for day in week]))) / 20,
            float(np.mean([day.IRRAD for day in week])) / 2e7,
        ]
        return np.clip(np.array(entries, np.float32), 0.0, 3.0)


def three_dates(env: gymnasium.Env) -> Policy:
    """60 kg/ha at each of three development stages: after emergence, at tillering, and when the stems grow."""
    return lambda observation: np.array(
        [
            float(
                round(300 * float(observation[6]))
                < 60 * np.sum(2 * float(observation[1]) >= np.array([0.05, 0.26, 0.55]))
            )
        ],
        np.float32,
    )


def no_nitrogen(env: gymnasium.Env) -> Policy:
    """Spread nothing."""
    return lambda observation: np.zeros(1, np.float32)


RULES: dict[str, Callable[[gymnasium.Env], Policy]] = {"three dates": three_dates, "no nitrogen": no_nitrogen}
"""Rules of thumb by name."""


@functools.cache
def data() -> Any:
    """The data that PCSE brings for its tests, as (weather, crop, soil, site)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import pcse
        from pcse.input import CABOWeatherDataProvider, PCSEFileReader

    logging.getLogger("pcse").setLevel(logging.CRITICAL)
    folder = Path(str(pcse.__file__)).parent / "tests" / "test_data"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # the reader leaves its files open
        files = [PCSEFileReader(str(folder / f"lintul3_springwheat.{name}")) for name in ("crop", "soil", "site")]
    return CABOWeatherDataProvider("NL1", fpath=f"{folder}/"), *files


def weather() -> Any:
    """Return the weather, a function of the date."""
    return data()[0]


@functools.cache
def find_years(split: Split) -> tuple[int, ...]:
    """Return the years of a split. Only years whose weather is complete are in one."""
    from pcse.exceptions import WeatherDataProviderError

    def is_complete(year: int) -> bool:
        try:
            return all(weather()(datetime.date(year, 1, 1) + datetime.timedelta(days=day)) for day in range(300))
        except WeatherDataProviderError:
            return False

    years = [year for year in range(weather().first_date.year, weather().last_date.year + 1) if is_complete(year)]
    return tuple(year for index, year in enumerate(years) if (index % 3 == 1) == (split == "test"))


def start_crop(year: int) -> Any:
    """Return LINTUL3 on the day before emergence of a year."""
    from pcse.base import ParameterProvider
    from pcse.models import LINTUL3

    emergence = datetime.date(year, *EMERGENCE)
    calendar = {
        "crop_name": "wheat",
        "variety_name": "spring-wheat",
        "crop_start_date": emergence,
        "crop_start_type": "emergence",
        "crop_end_date": datetime.date(year, 10, 20),
        "crop_end_type": "earliest",
        "max_duration": 300,
    }
    begin = datetime.date(year, 1, 1)
    agenda = [{begin: {"CropCalendar": calendar, "TimedEvents": None, "StateEvents": None}}]
    provider, crop, soil, site = data()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = LINTUL3(ParameterProvider(sitedata=site, soildata=soil, cropdata=crop), provider, agenda)
        model.run(days=(emergence - begin).days)
    return model


def spread(model: Any, amount: float) -> None:
    """Spread nitrogen (g/m²). Crop and soil listen to the signal by different names of its values."""
    from pcse import signals

    model._send_signal(signal=signals.apply_n, amount=amount, recovery=RECOVERY, N_amount=amount, N_recovery=RECOVERY)
