"""Tasks of real simulators whose score exists only at the end of an episode.

Importing this package registers the Gymnasium environments. It does not import any simulator. `NAME-v0` plays training episodes,
`NAMETest-v0` the held-out ones, and `NAMEProxy-v0` training episodes that pay a dense proxy of the score in each step, where the task
has one.
"""

import gymnasium

__all__ = ["TASKS"]

TASKS = {
    "Grid": ("final_score.grid:Grid", 48),
    "JobShop": ("final_score.jobshop:JobShop", 400),
    "Traffic": ("final_score.traffic:Traffic", 360),
    "Wheat": ("final_score.wheat:Wheat", 30),
}
"""Entry point and longest episode (steps) of each Gymnasium task."""

for _name, (_entry_point, _max_steps) in TASKS.items():
    for _ending, _arguments in {"": {}, "Test": {"split": "test"}, "Proxy": {"pay": "proxy"}}.items():
        gymnasium.register(f"{_name}{_ending}-v0", _entry_point, max_episode_steps=_max_steps, kwargs=_arguments)
