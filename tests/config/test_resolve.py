"""Which settings, method, algorithm and task go together, and the defaults of open values."""

import pytest

from helpers.toy_envs import pick_spec, toy_spec
from lare_rl.algorithms.qmix import QMIXSettings
from lare_rl.config.replay_size import replay_rows
from lare_rl.config.resolve import resolve
from lare_rl.config.settings import Settings
from lare_rl.credit.decoder_settings import MULTI_AGENT_CREDIT, RECENT_STEPS, CreditSettings
from lare_rl.envs.load import read_task
from lare_rl.errors import LareError


def resolve_named(task, settings):
    return resolve(Settings(**settings), read_task(task))


@pytest.mark.parametrize(
    ("task", "settings", "texts"),
    [
        ("CN-6", {"algorithm": "td3"}, ["td3", "single agent", "6", "ippo"]),
        ("Reacher-v4", {"algorithm": "ippo", "steps": 1000}, ["ippo", "many agents", "td3"]),
        ("CompetitivePP-6", {"algorithm": "qmix"}, ["qmix", "one team", "2", "ippo"]),
        ("CompetitivePP-6-prey", {}, ["one team of", "CompetitivePP-6"]),
        ("Reacher-v4", {"algorithm": "vdn"}, ["vdn", "discrete", "Reacher-v4"]),
        ("CN-6", {"method": "stas", "rollout_steps": 10}, ["stas", "rollout_steps = 10", "25"]),
        ("CN-6", {"method": "diaster"}, ["diaster", "single agent", "6"]),
        ("Reacher-v4", {"method": "llm-reward", "judges": "both"}, ["llm-reward", "judges"]),
        ("Reacher-v4", {"method": "ircr", "scale_rewards": True}, ["scale_rewards", "ircr"]),
        ("Reacher-v4", {"method": "rrd", "credit": {"steps": 16}}, ["steps = 16", "drawn_steps = 64"]),
        ("CN-6", {"steps": 5000}, ["steps = 5000", "2050", "environments = 82", "4100 or 6150"]),
        ("Reacher-v4", {"steps": 1001}, ["steps = 1001", "rollout_steps = 50", "1000 or 1050"]),
        ("Reacher-v4", {"steps": 1000, "evaluate_every": 40}, ["evaluate_every = 40", "use 50"]),
        ("Reacher-v4", {"rollout_steps": 20, "steps": 20}, ["steps = 20", "50"]),
        ("CN-6", {"capacity": 6149, "method": "rd"}, ["capacity = 6149", "rollout", "6150"]),
        ("CN-6", {"algorithm": "qmix", "method": "rd", "capacity": 999}, ["capacity = 999", "iteration", "1000"]),
    ],
)
def test_resolve_refuses(task, settings, texts):
    with pytest.raises(LareError) as error:
        resolve_named(task, settings)
    assert all(text in str(error.value) for text in texts)


def test_resolve_refuses_continuous_algorithm_for_choices():
    with pytest.raises(LareError, match=r"sac needs continuous actions.*ppo"):
        resolve(Settings(algorithm="sac"), pick_spec())


def test_resolve_refuses_method_of_agents_on_team_level(echo):
    task = echo.model_copy(update={"judged_from": "state", "observation_size": 9, "action_size": 9})
    with pytest.raises(LareError, match=r"lare-rd-shared.*global state"):
        resolve(Settings(method="lare-rd-shared"), task)


@pytest.mark.parametrize(
    ("task", "settings", "expected"),
    [
        (
            toy_spec(),
            {},
            {"algorithm": "td3", "method": "lare-bayes", "steps": 1_000_000, "evaluate_every": 5000, "environments": 1}
            | {"rollout_steps": 50, "capacity": 1_000_000, "credit": CreditSettings()},
        ),
        (
            pick_spec(),
            {},
            {"algorithm": "ppo", "method": "lare-bayes", "steps": 1_000_000, "evaluate_every": 10_000, "fit_every": 1}
            | {"environments": 1, "rollout_steps": 2000, "fit_updates": 500},
        ),
        (
            read_task("CN-6"),
            {},
            {"algorithm": "ippo", "method": "lare-bayes", "steps": 2_050_000, "environments": 82, "rollout_steps": 25}
            | {"evaluate_every": 20_500, "evaluation_episodes": 50, "fit_every": 10, "fit_updates": 50}
            | {"credit": MULTI_AGENT_CREDIT, "first_fit": None},
        ),
        (read_task("CN-6"), {"method": "lare-rd"}, {"first_fit": "held-out"}),
    ],
)
def test_resolve_defaults(task, settings, expected):
    resolved = resolve(Settings(**settings), task)
    assert {name: getattr(resolved, name) for name in expected} == expected


def test_resolve_defaults_of_qmix(echo):
    resolved = resolve(Settings(), echo)
    assert (resolved.algorithm, resolved.method, resolved.hyperparameters) == ("qmix", "lare-rd", QMIXSettings())
    assert (resolved.environments, resolved.evaluation_episodes, resolved.capacity) == (8, 32, 5000 * 7)
    assert resolved.steps % resolved.iteration_steps == resolved.evaluate_every % resolved.iteration_steps == 0
    assert abs(resolved.steps - 2_000_000) < 400


def test_resolve_keeps_given_values():
    settings = Settings(method="dense", steps=4100, evaluate_every=2050, evaluation_episodes=3)
    resolved = resolve(settings, read_task("CN-6"))
    assert {name: getattr(resolved, name) for name in settings.model_fields_set} == settings.model_dump(
        exclude_unset=True
    )


@pytest.mark.parametrize(("task", "default"), [("CN-6", MULTI_AGENT_CREDIT), ("Reacher-v4", CreditSettings())])
@pytest.mark.parametrize("changes", [{"learning_rate": 0.5}, {"hidden": (256, 256)}])
def test_resolve_completes_credit(task, default, changes):
    """A set value replaces the algorithm's, even if it is the default of the class."""
    for credit in (changes, CreditSettings(**changes)):
        assert resolve_named(task, {"credit": credit}).credit == default.model_copy(update=changes)


@pytest.mark.parametrize(
    ("settings", "fit_updates"),
    [
        ({"method": "rd", "algorithm": "ppo", "rollout_steps": 2000}, 500),
        ({"method": "diaster", "algorithm": "ppo", "rollout_steps": 2000}, 40),
        ({"method": "diaster", "algorithm": "ppo", "rollout_steps": 2000, "fit_updates": 120}, 120),
        ({"method": "diaster", "environments": 4}, 4),
    ],
)
def test_resolve_fit_updates(settings, fit_updates):
    """The fit of diaster is expensive: one update for 50 steps."""
    assert resolve_named("Reacher-v4", settings).fit_updates == fit_updates


@pytest.mark.parametrize(
    ("task_score", "user_score", "score"),
    [(None, "auto", "auto"), ("average", "auto", "average"), ("average", "sum", "sum"), ("sum", "average", "average")],
)
def test_resolve_score(task_score, user_score, score):
    settings = Settings(method="lare-linear", algorithm="td3", credit={"score": user_score})
    assert resolve(settings, toy_spec(score=task_score)).credit.score == score


def test_resolve_normalises_settings_without_effect():
    """Runs that are the same have the same settings."""
    fixed_length = [{"method": "lare-rd", "credit": {"score": score}} for score in ("auto", "sum", "average")]
    assert len({resolve_named("CN-6", settings) for settings in fixed_length}) == 1
    assert resolve_named("Reacher-v4", {"method": "bayes", "judges": "before"}).judges is None
    assert resolve_named("Reacher-v4", {"method": "bayes", "judges": "after"}).judges == "after"
    assert resolve_named("SMAX-2s3z", {"method": "rd"}).credit.score == "sum"


@pytest.mark.parametrize(
    ("task", "settings", "max_steps", "rows"),
    [
        ("Reacher-v4", {"algorithm": "ppo", "method": "rrdu", "steps": 100_000}, 50, 200_002),
        ("Reacher-v4", {"algorithm": "ppo", "method": "dense", "steps": 100_000}, 50, 2 * 2000 + 50 + RECENT_STEPS),
        ("Reacher-v4", {"algorithm": "ppo", "method": "dense", "steps": 2000, "evaluate_every": 2000}, 50, 4050),
        ("CN-6", {"method": "rrdu"}, 25, 15_000 * 26 // 82),
        ("CN-6", {"method": "dense"}, 25, 2 * 25 + 25 + RECENT_STEPS // 82),
    ],
)
def test_replay_rows(task, settings, max_steps, rows):
    assert replay_rows(resolve_named(task, settings), max_steps) == rows
