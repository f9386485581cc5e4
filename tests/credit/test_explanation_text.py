import numpy as np
import pytest

from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.explanation import Explanation
from lare_rl.credit.explanation_text import MESSAGES, explanation_findings
from lare_rl.credit.input_names import raw_feature_names
from lare_rl.credit.methods import METHODS
from lare_rl.credit.score_type import ScoreType, ScoreTypeEstimate
from lare_rl.credit.spec import CreditSpec
from lare_rl.util.findings import Finding, render

FACTORS, RAW_FEATURES = ["speed", "cost"], ["entry 0", "entry 1 (the foot)"]
BOTH_STATES = ["speed (before)", "speed (after)"]
WELL_EXPLAINED = {"factors_r2": 0.99, "total_r2": 0.99, "factor_shares": np.array([0.34, 0.65])}
ONE_VARIES = WELL_EXPLAINED | {"factor_varies": np.array([True, False])}
CANCELLING = WELL_EXPLAINED | {"slope": np.array([-20.5, 20.1])}
NO_RESIDUAL, LARGE_RESIDUAL = ({"residual_correlation": np.array([size, 0])} for size in (0, 0.5))


def explanation(**changes):
    values = {
        "n_episodes": 40,
        "mean_length": 10,
        "explains_mean_reward": False,
        "total_r2": 0.97,
        "raw_feature_used": np.array([True, True]),
        "raw_feature_shares": np.zeros(2),
        "factors_r2": 0.9,
        "factor_varies": np.array([True, True]),
        "factor_shares": np.array([0.25, 0.65]),
        "pair_shares": np.zeros(2),
        "slope": np.array([1.0, 2.0]),
        "slope_covariance": np.diag([0.01, 0.01]),
        "linear_share": np.array([0.81, 1.0]),
        "std": np.array([2.0, 0.5]),
        "terminal": np.array([False, False]),
        "same_as": np.array([-1, -1]),
        "residual_correlation": np.array([0.1, -0.8]),
    }
    return Explanation(**(values | changes))


def find(changes, factors=FACTORS, raw_features=(), score_type=None, **options):
    return explanation_findings(explanation(**changes), score_type, factors, raw_features, **options)


ABOUT = "factors_explain about_factors"
LACKING = NO_RESIDUAL | {"factors_r2": 0.8, "raw_feature_shares": np.array([0.02, 0.4])}


@pytest.mark.parametrize(
    ("changes", "factors", "raw_features", "codes"),
    [
        ({}, FACTORS, RAW_FEATURES, f"{ABOUT} factor factor about_shares high_when_small"),
        ({}, FACTORS, [], f"{ABOUT} factor factor about_shares"),
        (LARGE_RESIDUAL, FACTORS, RAW_FEATURES, f"{ABOUT} factor factor about_shares high_when_large"),
        (NO_RESIDUAL | {"factors_r2": 0.05}, FACTORS, [], "factors_explain phi_explains_little"),
        (WELL_EXPLAINED, FACTORS, RAW_FEATURES, f"{ABOUT} factor factor about_shares"),
        (LACKING, FACTORS, RAW_FEATURES, f"{ABOUT} factor factor about_shares phi_lacks_features"),
        (WELL_EXPLAINED, BOTH_STATES, [], f"{ABOUT} factor about_shares about_states"),
        (CANCELLING, BOTH_STATES, [], f"{ABOUT} factor about_shares"),
        (ONE_VARIES, BOTH_STATES, [], f"{ABOUT} factor about_shares"),
        (ONE_VARIES, FACTORS, [], f"{ABOUT} unknown_factor factor about_shares"),
        ({}, [], [], "raw_features_explain"),
        ({"raw_feature_used": np.array([True, False])}, [], RAW_FEATURES, "raw_features_explain unused_raw_features"),
        (WELL_EXPLAINED | {"raw_feature_used": np.zeros(2, bool)}, FACTORS, [], f"{ABOUT} factor factor about_shares"),
        ({"n_episodes": 19}, FACTORS, RAW_FEATURES, ""),
        ({"n_episodes": 20}, [], [], "raw_features_explain"),
        ({"total_r2": np.nan}, FACTORS, RAW_FEATURES, "equal_returns"),
    ],
)
def test_codes(changes, factors, raw_features, codes):
    findings = find(changes, factors, raw_features)
    assert [finding.code for finding in findings] == codes.split()
    texts = [render(finding, MESSAGES) for finding in findings]
    assert all(text and "{" not in text for text in texts)


def test_shares_groups_and_missing_pairs():
    values = find({}, raw_features=RAW_FEATURES)[0].values
    assert (values["share"], values["target"]) == (0.9, Finding("returns", {"n_episodes": 40, "groups": None}))
    assert values["raw"].values["share"] == pytest.approx(0.07)
    assert find({"total_r2": 0.909}, raw_features=RAW_FEATURES)[0].values["raw"] is None
    changes = {"raw_feature_shares": np.array([0.2, 0.77]), "explains_mean_reward": True}
    values = find(changes, [], RAW_FEATURES)[0].values
    assert (values["share"], values["target"].code) == (0.97, "mean_rewards")
    largest = [feature.values for feature in values["largest"].values["features"]]
    assert largest == [{"name": RAW_FEATURES[1], "share": 0.77}, {"name": RAW_FEATURES[0], "share": 0.2}]
    shares = {"factors_r2": 0.905, "total_r2": 0.931, "factor_shares": np.array([0.2545, 0.6505])}
    about, _, *factors = find(shares, raw_features=RAW_FEATURES)[:4]
    assert (about.values["share"], about.values["raw"].values["share"]) == (0.90, 0.03)  # and 7% is not explained
    assert [factor.values["share"] for factor in factors] == [0.65, 0.25]
    lines = [render(finding, MESSAGES) for finding in find({})[2:4]]
    assert lines == ["- cost: 65%, +2 ± 0.1", "- speed: 25%, +1 ± 0.1"]
    effects = {f"map {i}": float(-i if i == 5 else i) for i in range(11)}  # no episode was fitted to the first
    (finding,) = (finding for finding in find({}, groups=effects) if finding.code == "groups_differ")
    assert [group.values["name"] for group in finding.values["groups"]] == [f"map {i}" for i in range(10, 2, -1)]
    assert finding.values["more"].values == {"count": 2}
    target = find({}, groups={"easy": 2.0}, only_at_end=False)[1].values["target"]
    assert target == Finding("payments", {"n_episodes": 40, "groups": Finding("with_groups")})
    missing = find({}, (), RAW_FEATURES, lacks_pairs=True)[-1]
    assert missing == Finding("products_not_read", {"n_raw": 2, "most": 12})


def test_score_type():
    types = {ScoreType.SUM: Finding("sum"), ScoreType.AVERAGE: Finding("mean")}
    for score_type, rival in ((ScoreType.SUM, ScoreType.AVERAGE), (ScoreType.AVERAGE, ScoreType.SUM)):
        for is_certain, code in ((True, "score_type_is_certain"), (False, "score_type_is_uncertain")):
            estimate, values = ScoreTypeEstimate(score_type, is_certain, rival), {"this": types[score_type]}
            for is_binary, advice in ((False, Finding("set_score_type")), (True, None)):
                finding = find({}, score_type=estimate, is_binary=is_binary)[0]
                assert finding == Finding(code, values | {"other": types[rival], "advice": advice})
        finding = find({}, score_type=ScoreTypeEstimate(score_type, is_certain=True, rival=ScoreType.LOG_ODDS))[0]
        assert finding == Finding("score_is_not_log_odds", {"this": types[score_type]})


@pytest.mark.parametrize(
    ("std", "linear_share", "code"),
    [(0.49, 1, "effect"), (0.51, 1, "unclear_effect"), (0.51, 0, "effect"), (0, 1, "effect")],
)
def test_unclear_effects(std, linear_share, code):
    """An effect of less than two posterior deviations is unclear, unless both are tiny. The line through a curved effect may be flat."""
    changes = {"slope_covariance": np.diag([std**2, 0.01]), "linear_share": np.array([linear_share, 1.0])}
    tiny = changes | {"slope": np.array([std / 100, 2.0]), "slope_covariance": np.diag([(std / 60) ** 2, 0.01])}
    for values, expected in ((changes, code), (tiny, "effect")):
        (speed,) = (finding for finding in find(values) if finding.values.get("name") == "speed")
        assert speed.values["effect"].code == expected


@pytest.mark.parametrize(
    ("changes", "shapes"),
    [
        ({"linear_share": np.array([0.79, 0.1]), "factor_shares": np.array([0.95, 0.04])}, ["is_curved", None]),
        ({"linear_share": np.zeros(2), "pair_shares": np.array([0.13, 0.3])}, ["is_curved", "depends_on_factor"]),
        ({"same_as": np.array([1, 0])}, ["same_as", "same_as"]),
        ({"terminal": np.array([True, False])}, [None, "terminal"]),
    ],
)
def test_shapes_of_effects(changes, shapes):
    factors = [finding for finding in find(changes) if finding.code == "factor"]
    assert [shape and shape.code for shape in (finding.values["shape"] for finding in factors)] == shapes


def test_factor_before_and_after():
    covariance = np.array([[0.01, -0.0098], [-0.0098, 0.01]])
    values = find(WELL_EXPLAINED | {"slope_covariance": covariance}, BOTH_STATES)[2].values
    assert (values["name"], values["share"]) == ("speed", 0.99)
    assert values["effect"].values == pytest.approx({"slope": 3.0, "std": 0.02})
    assert values["states"].values["after"].values == pytest.approx({"slope": 2.0, "std": 0.1})
    for slope, cancels in (([-20.5, 20.1], True), ([-0.15, 0.15], False), ([-20.5, 17.0], False)):
        values = find(WELL_EXPLAINED | {"slope": np.array(slope)}, BOTH_STATES)[2].values
        assert (values["effect"].code == "change_pays") == (values["states"] is None) == cancels
    effect = find(CANCELLING, BOTH_STATES)[2].values["effect"]
    assert effect.values["slope"] == pytest.approx(20.3)
    assert find({"same_as": np.array([1, 0])}, BOTH_STATES)[2].values["shape"] is None
    assert find(ONE_VARIES, BOTH_STATES)[2].values["states"].values["after"] == Finding("equal_means")


def test_raw_feature_names():
    """Neither a history nor a difference of observations has names."""
    observation, action = "- 0: price\n[1] (none)\n1:\n2. angle (rad), in a room of\n0.5 m\n", "0: torque"
    assert raw_feature_names(observation, action, {"next_observation": 3, "action": 1}) == [
        *("entry 0 of the observation (price)", "entry 1 of the observation"),
        *("entry 2 of the observation (angle (rad), in a room of)", "entry 0 of the action (torque)"),
    ]
    sizes = {"observation_size": 1, "action_size": 1, "single_agent": True, "agents": 1, "max_steps": 10}
    for method, expected in (
        ("bayes-progress", ["entry 0 of the observation (price)", "entry 0 of the action"]),
        ("rd", []),
    ):
        spec = CreditSpec(method=METHODS[method], settings=CreditSettings(), **sizes)
        assert spec.raw_feature_names("0: price", "") == expected
