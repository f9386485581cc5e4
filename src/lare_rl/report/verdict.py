"""A run in words: whether it learned, whether its proxy rewards explain the score, and what to do next."""

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from lare_rl.credit.basis import MOST_PAIRED

NEXT_TO_NOTHING, MOSTLY = 0.1, 0.8
"""R^2 of returns: proxy rewards below the first explain next to nothing of the score, above the second nearly all."""

FEW = 5
"""With fewer evaluations, the verdict says nothing about a trend."""


STUCK = 0.05
"""The returns of a policy that repeats one behaviour differ by less than this part of the deviation of random actions' returns."""


@dataclass(frozen=True)
class Facts:
    """The facts that a verdict is based on."""

    name: str
    """The name of the run."""
    steps: Float[np.ndarray, " evaluations"]
    returns: Float[np.ndarray, "seeds evaluations"]
    """True returns, means over the episodes of an evaluation."""
    random: Float[np.ndarray, " episodes"] = field(default_factory=lambda: np.zeros(0))
    """True returns of random actions; empty if they are not known."""
    of_evaluation: float = 0.0
    """The standard error of the mean return at the end, from episode to episode of the last evaluation."""
    at_the_end: float | None = None
    """The last return of another run, which was trained on the return at the end alone; None without such a run."""
    return_r2: float | None = None
    """How well returns were predicted before anything was fitted to them; None if the method predicts none."""
    usual_r2: float | None = None
    """The median of the same over all evaluations and seeds."""
    seen: str = "raw entries"
    """The inputs of the decoder: `factors`, `raw entries`, or both."""
    many: bool = False
    """Whether there are many agents."""
    descends: bool = False
    """Whether its decoder descends a gradient, and so may not have learned yet what it sees."""
    untrained: str | None = None
    """Why the policy was never trained; None if it was."""
    warmup: int = 0
    """The steps before the first update."""
    before: Float[np.ndarray, " seeds"] | None = None
    """The returns of the policies before their first update; None if they were not evaluated."""
    saturated: int = 0
    """How many seeds' policies choose the same action, at its bounds, in all states at the end."""
    directory: str = "RUN"
    task: str = "TASK"
    """The name of a shipped task, or a placeholder for a task file, which ends in `.toml`."""

    @property
    def latent(self) -> bool:
        """Whether the method has a phi."""
        return "factors" in self.seen

    @property
    def last(self) -> float:
        """The mean over the seeds at the end."""
        return float(np.nanmean(self.returns[:, -1]))

    @property
    def spread(self) -> float:
        """The deviation over the seeds at the end; 0 for one seed."""
        return float(np.nanstd(self.returns[:, -1], ddof=1)) if len(self.returns) > 1 else 0.0


def verdict(run: Facts) -> list[str]:
    """A few sentences, the most important first; commands are in backticks."""
    if not np.isfinite(run.returns[:, -1]).any():
        return ["Nothing can be said: the last evaluation gave no return."]
    if run.untrained is not None:
        return [f"Nothing was learned: {run.untrained}."]
    if all_alike(run):
        return [
            f"Nothing can be learned: all episodes, of the policy and of random actions, have the return {shown(run.last)}.",
            "Next: does the environment pay, and before its time limit (`max_episode_steps`)?",
        ]
    return [learned(run), *compared(run), *told(run), *todo(run)]


def all_alike(run: Facts) -> bool:
    """Whether all known returns are the same, those of several episodes of random actions among them."""
    known = np.concatenate([run.returns[np.isfinite(run.returns)], run.random])
    return bool(len(run.random) > 1 and np.ptp(known) == 0)


def learned(run: Facts) -> str:
    """Whether it is better than random actions, and than the policy before training."""
    reached = f"The return is {shown(run.last)}" + (f" ± {shown(run.spread)}" if run.spread else "")
    reached += f" after {int(run.steps[-1]):,} steps"
    reached += f" (mean over {len(run.returns)} seeds)" if len(run.returns) > 1 else ""
    if not len(run.random):
        return f"{reached}."
    episodes = "1 episode" if len(run.random) == 1 else f"{len(run.random)} episodes"
    by_chance = f"random actions get {shown(float(run.random.mean()))} ± {shown(deviation(run.random))} in {episodes}"
    if run.before is not None:
        policy = "the policy before training" if len(run.before) == 1 else "the policies of the seeds before training"
        by_chance += f", {policy} {', '.join(shown(float(one)) for one in run.before)}"
    if has_learned(run):
        return f"It learned. {reached}; {by_chance}."
    if seeds := successes(run):
        return f"It learned with {seeds} of {len(run.returns)} seeds. {reached}; {by_chance}."
    if run.last < run.random.mean() - 2 * noise(run):
        return f"It got worse than random actions. {reached}; {by_chance}."
    if may_have_learned(run):
        other = "the policy before training" if better_than_chance(run) else "random actions"
        return f"It may have learned, but the difference from {other} is less than two standard errors. {reached}; {by_chance}."
    return f"It has not learned yet. {reached}; {by_chance}."


def successes(run: Facts) -> int:
    """How many seeds end above random actions by two deviations of their returns, and above their own return before training by two
    standard errors of the difference, from episode to episode.
    """
    bar = float(run.random.mean()) + 2 * max(deviation(run.random), 1e-9)
    of_seed = math.sqrt(2 * len(run.returns)) * run.of_evaluation
    before = -np.inf if run.before is None else run.before + 2 * of_seed
    return int(np.sum(run.returns[:, -1] > np.maximum(bar, before)))


def has_learned(run: Facts) -> bool:
    """Whether the mean return is above random actions, and above the policies before training, by two standard errors."""
    return better_than_chance(run) and has_gained(run, 2)


def may_have_learned(run: Facts) -> bool:
    """Whether it is above both by one standard error, but not by two: more episodes can tell."""
    return float(run.random.mean()) + noise(run) < run.last and has_gained(run, 1) and not has_learned(run)


def has_gained(run: Facts, errors: int) -> bool:
    """Whether the mean return is above that before training by so many standard errors of the difference, taken seed by seed."""
    if run.before is None:
        return True
    gains = run.returns[:, -1] - run.before
    error = max(math.sqrt(2) * run.of_evaluation, deviation(gains) / math.sqrt(len(gains)), 1e-9)
    return bool(np.nanmean(gains) > errors * error)


def better_than_chance(run: Facts) -> bool:
    """Whether the mean return over the seeds is above that of random actions by two standard errors of their difference."""
    return run.last > float(run.random.mean()) + 2 * noise(run)


def noise(run: Facts) -> float:
    """`error_of_difference`, a little above 0."""
    return max(error_of_difference(run), 1e-9)


def error_of_difference(run: Facts) -> float:
    """The standard error of the difference between the mean return over the seeds and that of random actions."""
    of_random = deviation(run.random) / math.sqrt(max(1, len(run.random)))
    return math.hypot(of_random, error_at_the_end(run))


def error_at_the_end(run: Facts) -> float:
    """The standard error of the return at the end. It has two, from seed to seed and from episode to episode; the larger counts."""
    return max(run.of_evaluation, run.spread / math.sqrt(len(run.returns)))


def deviation(values: Float[np.ndarray, " episodes"]) -> float:
    """The standard deviation (n - 1); 0 for fewer than two values."""
    return float(values.std(ddof=1)) if len(values) > 1 else 0.0


def compared(run: Facts) -> list[str]:
    """A comparison with training on the return at the end alone, whose standard error is taken to be as large."""
    if run.at_the_end is None:
        return []
    above, bar = run.last - run.at_the_end, 2 * math.sqrt(2) * error_at_the_end(run)
    way = "about as much as" if abs(above) <= bar else "more than" if above > 0 else "less than"
    return [f"That is {way} training on the return at the end alone gives here ({shown(run.at_the_end)})."]


def told(run: Facts) -> list[str]:
    """Whether the proxy rewards explain the score."""
    if run.return_r2 is None or not np.isfinite(run.return_r2):
        return []
    share, usual = run.return_r2, run.usual_r2
    if not explains_nothing(run) and usual is not None and share < NEXT_TO_NOTHING:
        return [
            f"Its proxy rewards, from {run.seen}, usually explain {part(usual)} of the score (median R² of returns: {usual:.2f}), "
            f"but not the last episodes (R² {share:.2f}): perhaps the policy has changed, and the decoder has not adapted yet."
        ]
    return [
        f"Its proxy rewards, from {run.seen}, explain {part(share)} of the score: R² of the last returns, before they were learned "
        f"from, is {share:.2f}."
    ]


def part(r2: float) -> str:
    """How much of the score an R^2 of returns is, in words."""
    return "next to nothing" if r2 < NEXT_TO_NOTHING else "nearly all" if r2 > MOSTLY else "a part"


def explains_nothing(run: Facts) -> bool:
    """Whether returns are known to be explained neither at the end nor in most evaluations before."""
    if run.return_r2 is None or not np.isfinite(run.return_r2):
        return False
    usual = -np.inf if run.usual_r2 is None or not np.isfinite(run.usual_r2) else run.usual_r2
    return max(run.return_r2, usual) < NEXT_TO_NOTHING


def todo(run: Facts) -> list[str]:
    """What to do next."""
    found = []
    if explains_nothing(run):
        found.append(what_explains(run))
    elif is_rising(run):
        found.append(
            f"Next: it was still rising. To continue: `lare-rl train --resume {run.directory} --steps {2 * int(run.steps[-1])}`."
        )
    elif (best := seed_above_chance(run)) is not None:
        step, value = best
        found.append(
            f"Next: one seed was better than random actions at step {step:,} ({shown(value)}). `lare-rl evaluate {run.directory} "
            "--best` plays the best policy of each seed. To continue: more `--steps`, or another `--algorithm`."
        )
    elif (best := fell_from(run)) is not None:
        step, value = best
        found.append(
            f"Next: it was better before, {shown(value)} at step {step:,}. `lare-rl evaluate {run.directory} --best` plays the best "
            "policy of each seed."
        )
    elif (why := stuck(run)) is not None:
        found.append(
            f"Next: {why}. More `--steps` alone will not change that. Bring observations to about -1 to 1, or try another "
            "`--algorithm` (`lare-rl algorithms`), or more random steps at first."
        )
    elif len(run.random) and not has_learned(run):
        good = (run.return_r2 or 0) > MOSTLY
        own_rule = " (a rule of your own can tell: docs/bring-your-own-task.md, section 4)" if is_own(run) else ""
        exactly = (
            f"`lare-rl evaluate {run.directory} --episodes 50` tells more exactly; then "
            if may_have_learned(run) and not better_than_chance(run)
            else ""
        )
        division = ", or how the rewards are divided among the agents, which returns do not show" if run.many else ""
        limit = f"The proxy rewards predict returns well, so the algorithm, or the number of steps, may be the limit{division}"
        found.append(
            (f"{limit}{own_rule}. " if good else "")
            + f"Next: {exactly}more `--steps`, or another `--algorithm` (`lare-rl algorithms`)."
        )
        if good and not run.latent:
            found.append(
                f"If state and action have more than {MOST_PAIRED} entries together, a score that depends on products of them, "
                "such as price times power, needs a phi (`lare-rl prompt`)."
            )
    if not found and is_own(run) and len(run.random) and has_learned(run):
        found.append(
            "Next: better than random actions may be far from good: compare it with a rule of your own."
            + higher_before(run)
        )
    if len(run.returns) == 1:
        found.append("One seed says little: another one may reach a different return (`--seeds 3`).")
    return found


def is_own(run: Facts) -> bool:
    """Whether the task is one of the user's own."""
    return run.task.endswith(".toml")


def what_explains(run: Facts) -> str:
    """What to try if proxy rewards explain next to nothing of the score."""
    if run.latent:
        why = "phi misses what the score depends on"
        then = f"another phi (`lare-rl design {run.task} --reflect 2 --model NAME`), or none (`--method bayes`)"
    else:
        why, then = "the raw entries do not show what the score depends on", f"a phi (`lare-rl prompt {run.task}`)"
    if not run.descends:
        return f"Next: {then}, because {why}."
    return (
        f"Next: `--method {'lare-bayes' if run.latent else 'bayes'}`, whose decoder needs no updates. If that explains the score, "
        f"this decoder has not learned it yet: more `--steps`. If not, {why}: {then}."
    )


def quarters(run: Facts) -> tuple[float, float, float] | None:
    """The means of the last two quarters of the evaluations, and how much evaluations vary from one to the next."""
    mean = np.nanmean(run.returns, axis=0)
    if len(mean) < FEW:
        return None
    size = max(1, len(mean) // 4)
    noise = float(np.nanmedian(np.abs(np.diff(mean[-2 * size :])))) if size > 1 else float(abs(mean[-1] - mean[-2]))
    return float(mean[-2 * size : -size].mean()), float(mean[-size:].mean()), noise


def is_rising(run: Facts) -> bool:
    """Whether the last quarter is higher than the one before by more than evaluations vary, and by the error of the return at the
    end; and whether it rises by half of that variation itself.
    """
    found = quarters(run)
    if found is None:
        return False
    before, end, variation = found
    last = np.nanmean(run.returns, axis=0)[-max(2, run.returns.shape[1] // 4) :]
    return bool(end - before > max(variation, error_at_the_end(run)) and last[-1] - last[0] > variation / 2)


def stuck(run: Facts) -> str | None:
    """Why the policy is known to repeat one behaviour, where it is no better than random actions; None if it is not known to."""
    if not len(run.random) or better_than_chance(run):
        return None
    if run.saturated:
        seeds = f" with {run.saturated} of {len(run.returns)} seeds" if len(run.returns) > 1 else ""
        return f"the policy chooses the same action in every state{seeds}, with each entry at a bound"
    if run.returns.shape[1] < FEW or np.any(np.ptp(run.returns[:, -FEW:], axis=1) >= STUCK * deviation(run.random)):
        return None
    return f"it repeats one behaviour: the last {FEW} returns of a seed hardly differ, and those of random actions do"


def fell_from(run: Facts) -> tuple[int, float] | None:
    """Step and value of the best evaluation, where the end is lower by more than evaluations vary, and by two standard errors.

    None if the best evaluation is not better than random actions.
    """
    evaluations = quarters(run)
    if evaluations is None:
        return None
    _, end, variation = evaluations
    step, top = best_evaluation(run)
    start = float(run.random.mean()) if len(run.random) else float(np.nanmean(run.returns[:, 0]))
    if len(run.random) and top <= start + 2 * noise(run):
        return None
    fell = top - end > max(0.15 * abs(top - start), 2 * variation, 2 * math.sqrt(2) * error_at_the_end(run))
    return (step, top) if fell else None


def best_evaluation(run: Facts) -> tuple[int, float]:
    """Step and value of the highest mean over the seeds."""
    mean = np.nanmean(of_trained(run), axis=0)
    best = int(np.nanargmax(mean))
    return int(run.steps[best]), float(mean[best])


def higher_before(run: Facts) -> str:
    """A sentence on the best evaluation, if it is higher than the last one by a tenth of what was learned."""
    step, top = best_evaluation(run)
    if top - run.last <= 0.1 * (run.last - run.random.mean()):
        return ""
    return (
        f" The best evaluation was {shown(top)}, at step {step:,}: `lare-rl evaluate {run.directory} --best` plays its policy on "
        "other episodes."
    )


def of_trained(run: Facts) -> Float[np.ndarray, "seeds evaluations"]:
    """The returns, -inf for policies before their first update."""
    return np.where(run.steps > run.warmup, run.returns, -np.inf)


def seed_above_chance(run: Facts) -> tuple[int, float] | None:
    """Step and value of the best evaluation of any seed, if it beats random actions and the mean at the end does not."""
    if not len(run.random) or better_than_chance(run):
        return None
    found = of_trained(run)
    place, best = np.unravel_index(np.nanargmax(found), found.shape)
    top = float(found[place, best])
    above = top > run.random.mean() + 3 * max(deviation(run.random), 1e-9)
    return (int(run.steps[best]), top) if above else None


def shown(value: float) -> str:
    """A return as text, as a whole number if it is large."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def median_of_known(values: Float[np.ndarray, "seeds evaluations"]) -> float | None:
    """The median of all known values."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None


def last_known(values: Float[np.ndarray, "seeds evaluations"]) -> float | None:
    """The mean over the seeds at the last evaluation that has a known value."""
    for column in values.T[::-1]:
        if len(known := column[np.isfinite(column)]):
            return float(known.mean())
    return None
