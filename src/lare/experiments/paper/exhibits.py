"""THE table of exhibits: what the LaRe paper shows by training, as contenders on tasks, and what it says came out.

Two more need no training, and have files of their own: `correlations.py` (table 1) and `regret.py` (propositions 1 and 2).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lare.algorithms.table import Name
from lare.credit.settings import CreditSettings
from lare.experiments.scores import ERROR, RETURN, SUMMED_RETURN

OURS = "ours"
TRAVELLED, WON = "evaluation/x_position", "evaluation/won"


@dataclass(frozen=True)
class Contender:
    """A method with an algorithm, as it is named in the paper's figure."""

    label: str
    method: str
    algorithm: Name | None = None
    """The task's own, unless given."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Whatever else differs from what is usual."""
    draws: int = 1
    """Of the language model, at most: so many have been recorded."""
    ending: str = ""
    """Of the names of its runs, where another contender differs from it by settings alone."""


@dataclass(frozen=True)
class Claim:
    """What the paper says: one contender is better than the others, on every task that is shown."""

    better: str
    others: tuple[str, ...]
    at_least: bool = False
    """Whether it is only said to be as good."""


@dataclass(frozen=True)
class Exhibit:
    """A figure or a table."""

    name: str
    title: str
    source: str
    """Where it is in the paper; `OURS`, where it is not."""
    tasks: tuple[str, ...]
    """All of them; the first is for a quick look."""
    laptop: tuple[str, ...]
    """Those that a laptop tries."""
    contenders: tuple[Contender, ...]
    claims: tuple[Claim, ...]
    steps: int | None = None
    """Environment steps of every run, but for a quick look; the budget's, unless given."""
    key: str = RETURN
    """What is shown of a run, of the keys of metrics.jsonl."""
    printed: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    """The paper's figures, by task and label, where it prints any."""
    differences: tuple[str, ...] = ()
    """From the paper, besides those that all exhibits have."""

    def measure(self, task: str) -> str:
        """What is shown of a task: the fully sparse one pays 0 or 1, and is shown by how far it came; particle tasks by the sum
        over all agents, as in the paper.
        """
        if self.key != RETURN:
            return self.key
        of_task = {SPARSE: TRAVELLED} | dict.fromkeys(PARTICLES, SUMMED_RETURN)
        return of_task.get(task, RETURN)


SPARSE = "HalfCheetahSparse-v4"
STARCRAFT = ("SMAX-2s3z", "SMAX-3s_vs_5z", "SMAX-1c3s5z")
HIDDEN = tuple(
    f"{body}{score}-v4"
    for score in ("Target", "Threshold", "Saturating", "Foot")
    for body in ("HalfCheetah", "Walker2d")
)
PARTICLES = ("CN-6", "PP-6", "CN-15", "PP-15", "CN-30", "PP-30", "TriangleArea")
MUJOCO = ("Reacher-v4", "HalfCheetah-v4", "Walker2d-v4", "HumanoidStandup-v4")

DENSE = Contender("dense", "dense")
EPISODIC = Contender("episodic", "episodic")
RD, RRD, RRDU = Contender("RD", "rd"), Contender("RRD", "rrd"), Contender("RRD-unbiased", "rrdu")
IRCR, DIASTER = Contender("IRCR", "ircr"), Contender("Diaster", "diaster")
LARE_RD, LARE_RRDU = Contender("LaRe-RD", "lare-rd"), Contender("LaRe-RRDu", "lare-rrdu")
BAYES, LARE_BAYES = Contender("closed form, raw features", "bayes"), Contender("LaRe, closed form", "lare-bayes")
SHARED = Contender("LaRe without agent decomposition", "lare-rd-shared")
VIB = Contender("bottleneck", "vib-rrdu")

WHOLE = "Episodes of fewer than 64 steps are taken whole: RRD and RRD-unbiased are RD on Reacher-v4 (the paper: 64 steps of 50)."
ONE_DRAW = (
    "One draw of the language model each, and so one function against another: the seeds compare these two functions, not two "
    "ways to write functions. `candidates` has more draws."
)

FEW_EPISODES = {"credit": CreditSettings(steps=800)}
"""32 episodes in an update of the decoder, not 256: with attention a fit costs some 25 to 50 times as much as without."""
AREL = Contender("AREL", "arel", settings=FEW_EPISODES)
STAS = Contender("STAS", "stas", settings=FEW_EPISODES)
LARE_FEW = Contender("LaRe-RD, 32 episodes", "lare-rd", settings=FEW_EPISODES, ending="-few")
ATTENTION = (
    "AREL and STAS are fitted on 32 episodes at a time instead of 256: with all 256 a run of CN-6 takes 50 and 85 minutes, with "
    "other methods 4 to 6. So is the LaRe-RD that they are compared with."
)
AGENTS = (DENSE, EPISODIC, RD, RRD, AREL, STAS, LARE_RD, LARE_FEW, SHARED)
OF_AGENTS = (
    Claim("LaRe-RD", ("episodic", "RD", "RRD")),
    Claim("LaRe-RD, 32 episodes", ("AREL", "STAS")),
    Claim("LaRe-RD", ("dense",), at_least=True),
)
AMONG_AGENTS = Claim("LaRe-RD", ("LaRe without agent decomposition",))

OFF_AND_ON_POLICY: tuple[Name, ...] = ("td3", "sac", "ddpg", "ppo")


def with_algorithms() -> tuple[Contender, ...]:
    return tuple(
        Contender(f"{one.label}, {algorithm}", one.method, algorithm)
        for algorithm in OFF_AND_ON_POLICY
        for one in (DENSE, EPISODIC, RRDU, LARE_RRDU)
    )


TABLE = (
    Exhibit(
        "mujoco",
        "Returns on MuJoCo tasks",
        "figure 2",
        MUJOCO,
        MUJOCO[:3],
        (DENSE, EPISODIC, IRCR, RD, RRD, RRDU, DIASTER, LARE_RD, LARE_RRDU),
        (
            Claim("LaRe-RRDu", ("episodic", "IRCR", "RD", "RRD", "RRD-unbiased", "Diaster")),
            Claim("LaRe-RD", ("episodic", "IRCR", "RD", "RRD", "RRD-unbiased", "Diaster")),
            Claim("LaRe-RRDu", ("dense",), at_least=True),
        ),
        differences=(
            WHOLE,
            "IRCR is its reward alone, without half of each batch from the ten best episodes.",
            "Diaster's recurrent model is fitted once on 8 episodes for each 50 updates of TD3 (published: about once on 64 for "
            "each update).",
        ),
    ),
    Exhibit(
        "particles",
        "Returns on particle tasks",
        "figure 3",
        PARTICLES[:-1],
        ("CN-6", "PP-6"),
        AGENTS,
        (*OF_AGENTS, AMONG_AGENTS),
        differences=(ATTENTION,),
    ),
    Exhibit(
        "starcraft",
        "Win rates in StarCraft-like battles",
        "appendix E",
        STARCRAFT,
        STARCRAFT[:2],
        (
            Contender("dense (QMIX-DR)", "dense"),
            Contender("episodic (QMIX)", "episodic"),
            IRCR,
            RD,
            RRD,
            RRDU,
            LARE_RD,
        ),
        (
            Claim("LaRe-RD", ("episodic (QMIX)", "IRCR", "RD", "RRD", "RRD-unbiased")),
            Claim("LaRe-RD", ("dense (QMIX-DR)",), at_least=True),
        ),
        key=WON,
        differences=(
            "The battles are SMAX's (JaxMARL), not StarCraft II's: no shields, no splash, a scripted enemy, a field whose border "
            "kills.",
            "RRD draws 24 steps of an episode on every map; the paper says that it adjusted the number, not to what.",
            "IRCR pays every step of an episode alike, so that it also pays for lasting longer where lengths differ.",
            "The mixer is given the state by its running mean and deviation.",
        ),
    ),
    Exhibit(
        "triangle-area",
        "Returns on a task that no language model can have read about",
        "appendix D",
        ("TriangleArea",),
        ("TriangleArea",),
        AGENTS,
        OF_AGENTS,
        differences=(ATTENTION,),
    ),
    Exhibit(
        "ablations",
        "Without the reward model, and without self-prompting",
        "figure 5",
        MUJOCO,
        MUJOCO[:2],
        (
            EPISODIC,
            LARE_RRDU,
            Contender("without reward model", "lare-signs"),
            Contender("without self-prompting", "lare-rrdu", settings={"candidates": 1}),
            VIB,
        ),
        (
            Claim("LaRe-RRDu", ("without reward model", "without self-prompting", "bottleneck")),
            Claim("without reward model", ("episodic",)),
        ),
        differences=(WHOLE, ONE_DRAW),
    ),
    Exhibit(
        "candidates",
        "The number of candidates",
        "appendix F.1",
        ("Walker2d-v4", "HumanoidStandup-v4", "HalfCheetah-v4"),
        ("HalfCheetah-v4",),
        (
            Contender("n = 5", "lare-rrdu", draws=5),
            Contender("n = 1", "lare-rrdu", settings={"candidates": 1}, draws=5),
        ),
        (Claim("n = 5", ("n = 1",), at_least=True),),
        differences=(
            "The recordings hold n = 1 and n = 5; the paper shows more, and says that n makes no difference as long as it is large "
            "enough.",
            "HalfCheetah-v4 is ours.",
        ),
    ),
    Exhibit(
        "bottleneck",
        "A variational information bottleneck instead of a language model",
        "appendix F.2",
        MUJOCO,
        MUJOCO[:2],
        (RRDU, VIB, LARE_RRDU),
        (Claim("LaRe-RRDu", ("bottleneck", "RRD-unbiased")),),
        differences=(WHOLE,),
    ),
    Exhibit(
        "bottleneck-agents",
        "A bottleneck instead of a language model, with many agents",
        "appendix F.2",
        PARTICLES[:-1],
        ("CN-6",),
        (RD, Contender("bottleneck", "vib-rd"), LARE_RD),
        (Claim("LaRe-RD", ("bottleneck", "RD")),),
    ),
    Exhibit(
        "algorithms",
        "Other algorithms",
        "appendix F.3",
        MUJOCO,
        MUJOCO[1:2],
        with_algorithms(),
        tuple(
            claim
            for name in OFF_AND_ON_POLICY
            for claim in (
                Claim(f"LaRe-RRDu, {name}", (f"episodic, {name}", f"RRD-unbiased, {name}")),
                Claim(f"LaRe-RRDu, {name}", (f"dense, {name}",), at_least=True),
            )
        ),
        differences=(WHOLE,),
    ),
    Exhibit(
        "reward-design",
        "A reward function that the language model wrote",
        "appendix F.4",
        MUJOCO,
        MUJOCO[:2],
        (Contender("LLM reward design", "llm-reward"), LARE_RRDU),
        (Claim("LaRe-RRDu", ("LLM reward design",)),),
        differences=(WHOLE, ONE_DRAW),
    ),
    Exhibit(
        "errors",
        "Errors of the proxy reward, |r_hat - r|",
        "table 4, appendix F.5",
        ("Reacher-v4", "HalfCheetah-v4"),
        ("Reacher-v4", "HalfCheetah-v4"),
        (LARE_RRDU, RRDU, RD),
        (Claim("LaRe-RRDu", ("RRD-unbiased", "RD")),),
        key=ERROR,
        printed={
            "Reacher-v4": {"LaRe-RRDu": "0.0002 ± 0.0002", "RRD-unbiased": "0.011 ± 0.002", "RD": "0.004 ± 0.003"},
            "HalfCheetah-v4": {"LaRe-RRDu": "0.7 ± 0.5", "RRD-unbiased": "10.7 ± 4.1", "RD": "9.6 ± 8.5"},
        },
        differences=(WHOLE,),
    ),
    Exhibit(
        "sparse",
        "A fully sparse task: has it travelled more than 500 m?",
        "appendix F.6",
        (SPARSE,),
        (SPARSE,),
        (EPISODIC, RD, RRDU, LARE_RD, LARE_RRDU),
        (Claim("LaRe-RRDu", ("episodic", "RD", "RRD-unbiased")),),
        differences=(
            "As the text has it: 1 for more than 500 m. The published code pays 100 for more than 50 m.",
            "500 m are 10 m in each second of an episode, which TD3 hardly reaches on true rewards. As long as no episode comes "
            "that far, every return is 0 and says nothing about any method.",
        ),
    ),
    Exhibit(
        "hidden",
        "Scores that no text tells",
        OURS,
        HIDDEN,
        HIDDEN,
        (DENSE, EPISODIC, RRDU, LARE_RRDU, BAYES, LARE_BAYES),
        (Claim("LaRe, closed form", ("LaRe-RRDu", "RRD-unbiased"), at_least=True),),
        steps=60_000,
        differences=(
            "Ours. The bodies are those of the usual tasks, and so are their texts and the recorded replies; what is paid for is "
            "something else (src/lare/tasks/hidden.py). The language model cannot know this reward by heart.",
            "The claim is ours, made before the runs.",
        ),
    ),
)

EXHIBITS = {exhibit.name: exhibit for exhibit in TABLE}
