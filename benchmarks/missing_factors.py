"""How decoders learn with a `phi` that leaves a factor out, and with one that has nothing to do with the score.

    python benchmarks/missing_factors.py run RUNS [TASK/METHOD/FUNCTION ...]   train missing runs, resume the others
    python benchmarks/missing_factors.py keep RUNS                             copy finished runs to results/missing
    python benchmarks/table.py benchmarks/results/missing

FUNCTION is `all` (draw 0 of the recorded functions), `without-f_NAME` (the same function without this factor in its result) or
`irrelevant`. Every run is a run directory RUNS/TASK/METHOD/FUNCTION.
"""

import re
import sys
from pathlib import Path
from typing import Any

import lare_rl
from learning_curves import keep

SETTINGS: dict[str, dict[str, Any]] = {
    "HalfCheetah-v4": {"steps": 60_000, "seeds": 3},
    "PP-6": {"steps": 410_000, "seeds": 3, "first_fit": "published"},
}
FACTORS = {
    "HalfCheetah-v4": ("f_forward", "f_control", "f_posture", "f_pitch_rate", "f_bounce"),
    "PP-6": (
        *("f_distance", "f_catch", "f_closing", "f_pursuit"),
        *("f_surround", "f_team", "f_obstacle", "f_spacing"),
    ),
}
METHODS = {"HalfCheetah-v4": ("lare-bayes", "lare-rrdu"), "PP-6": ("lare-bayes", "lare-rd")}
NEEDED = {"HalfCheetah-v4": "f_forward", "PP-6": "f_catch"}
"""The factor that makes up most of the score. It is the only one that is left out for gradient-trained decoders."""
IRRELEVANT = {
    "HalfCheetah-v4": "[np.sin(3 * observation[:, 2:3]), np.square(observation[:, 3:4])]",
    "PP-6": "[np.sin(5 * observation[:, 4:5]), np.square(observation[:, 5:6])]",
}
"""Functions of an angle of the hind leg, and of the place of the nearest obstacle."""
RESULTS = Path(__file__).parent / "results" / "missing"


def experiments() -> list[str]:
    names = []
    for task, methods in METHODS.items():
        for method in methods:
            left_out = FACTORS[task] if method == "lare-bayes" else (NEEDED[task],)
            functions = ("all", *(f"without-{name}" for name in left_out), "irrelevant")
            names += [f"{task}/{method}/{function}" for function in functions]
    return names


def source(task: str, function: str) -> str:
    """The recorded function, whole or without a factor, or an irrelevant function."""
    if function == "irrelevant":
        return f"import numpy as np\n\n\ndef evaluation_func(observation, action):\n    return {IRRELEVANT[task]}\n"
    recorded = lare_rl.design(lare_rl.load_task(task)).source
    if function == "all":
        return recorded
    remaining = [name for name in FACTORS[task] if name != function.removeprefix("without-")]
    assert len(remaining) == len(FACTORS[task]) - 1
    changed, times = re.subn(r"return \[.*\]", f"return [{', '.join(remaining)}]", recorded)
    assert times == 1
    return changed


def run(directory: Path, names_to_run: list[str]) -> None:
    for name in names_to_run or experiments():
        task, method, function = name.split("/")
        out = directory / name
        if out.exists():
            lare_rl.resume(out)
            continue
        phi = directory / f"{task}-{function}.py"
        phi.parent.mkdir(parents=True, exist_ok=True)
        phi.write_text(source(task, function))
        settings = dict(SETTINGS[task])
        if method == "lare-bayes":
            settings.pop("first_fit", None)
        lare_rl.train(task, lare_rl.Settings(method=method, **settings), function=phi, out=out)


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["run", runs, *names_to_run]:
            run(Path(runs), names_to_run)
        case ["keep", runs]:
            keep(Path(runs), RESULTS)
        case _:
            sys.exit(__doc__)
