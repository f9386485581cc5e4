"""The recorded replies answer the texts of the tasks, and the files in `phi` are what they say."""

from pathlib import Path

import pytest

from lare_rl.envs.load import read_task
from lare_rl.latent.function import normalise_source
from lare_rl.latent.saved import read_source
from lare_rl.llm import prompts
from lare_rl.llm.recording import read_recording
from lare_rl.llm.reply import parse_reply

FOLDER = Path(__file__).parents[3] / "benchmarks" / "real"
NAMES = {"wheat": "Wheat", "traffic": "Traffic", "jobshop": "JobShop", "trains": "Trains", "grid": "Grid"}


@pytest.mark.parametrize("draw", [0, 1])
@pytest.mark.parametrize("name", NAMES)
def test_recording(name, draw):
    path = FOLDER / "recordings" / f"{NAMES[name]}.draw{draw}.json"
    recording = read_recording(path.read_text(encoding="utf-8"), path.name)
    task = read_task(FOLDER / "tasks" / f"{name}.toml").roles[0]
    candidates, combination = recording.exchanges
    assert candidates.messages == prompts.candidate(task)
    assert combination.messages == prompts.combine(task, candidates.replies)
    assert len(candidates.replies) == 5
    assert recording.draw == draw
    phi = read_source(FOLDER / "phi" / (f"{name}.py" if draw == 0 else f"{name}.draw1.py"))
    assert phi.source == normalise_source(parse_reply(combination.replies[0]).functions)
