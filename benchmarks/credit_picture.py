"""Draw the README's picture: the true rewards of an episode of CN-6, and the rewards that LaRe recovered from totals.

    lare-rl train CN-6 --steps 102500 --out RUN
    python benchmarks/credit_picture.py RUN

The episode has the median return of 31. It is written to docs/pictures/credit.svg.
"""

from pathlib import Path

import matplotlib
import numpy as np
import tyro
from jaxtyping import Float
from matplotlib.colors import to_hex

from lare_rl.evaluation.played_episodes import play_run
from lare_rl.runs.directory import open_run

PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "credit.svg"
N_EPISODES = 31
CELL, GAP, LEFT, TOP = 32, 1, 84, 34
STYLE = """text { font: 15px system-ui, sans-serif; fill: #24292f } .title { font-weight: 600 } .sum { fill: #57606a }
@media (prefers-color-scheme: dark) { text { fill: #e6edf3 } .sum { fill: #9da7b1 } }"""


def draw_panel(
    title: str, note: str, reward: Float[np.ndarray, "steps agents"], top: int, scale: np.ndarray
) -> list[str]:
    """Return the SVG of a map of rewards: a row for each agent, a column for each step."""
    colours = matplotlib.colormaps["viridis"](np.interp(reward, scale, (0, 1)))
    lines = [f'<text class="title" x="{LEFT}" y="{top - 12}">{title} <tspan class="sum">{note}</tspan></text>']
    for agent in range(reward.shape[1]):
        y = top + agent * CELL
        lines.append(f'<text x="{LEFT - 10}" y="{y + 21}" text-anchor="end">agent {agent + 1}</text>')
        for step in range(reward.shape[0]):
            colour = to_hex(colours[step, agent])
            box = f'x="{LEFT + step * CELL}" y="{y}" width="{CELL - GAP}" height="{CELL - GAP}"'
            lines.append(f'<rect {box} fill="{colour}"><title>{reward[step, agent]:.2f}</title></rect>')
    return lines


def main(run: tyro.conf.Positional[Path], out: Path = PICTURE) -> None:
    """Draw.

    Args:
        run: a finished run of many agents.
        out: the picture.
    """
    played = play_run(open_run(run), N_EPISODES)
    episode = int(np.argsort((played.reward.sum(axis=2) * played.mask).sum(axis=0))[N_EPISODES // 2])
    reward, proxy = played.select_episode((played.reward, played.proxy_reward), episode)
    assert proxy is not None
    n_steps, n_agents = reward.shape
    scale = np.percentile(np.stack([reward, proxy]), [2, 98])
    height = n_agents * CELL
    second = TOP + height + 70
    width, bottom = LEFT + n_steps * CELL, second + height
    lines = draw_panel("True rewards", f"(their sum is {reward.sum():.1f})", reward, TOP, scale)
    lines += draw_panel("Rewards that LaRe recovered", f"(their sum is {proxy.sum():.1f})", proxy, second, scale)
    lines.append(f'<text x="{LEFT}" y="{bottom + 24}">first step</text>')
    lines.append(f'<text x="{width}" y="{bottom + 24}" text-anchor="end">last step</text>')
    lines.append(
        f'<text class="sum" x="{(LEFT + width) / 2}" y="{bottom + 24}" text-anchor="middle">'
        f"dark: {scale[0]:.1f}, bright: {scale[1]:.1f}</text>"
    )
    body = "\n".join(lines)
    view = f'viewBox="0 0 {width} {bottom + 36}" width="{width}" height="{bottom + 36}"'
    out.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" {view} role="img">\n<style>{STYLE}</style>\n{body}\n</svg>\n'
    )


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
