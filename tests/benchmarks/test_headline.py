import pytest

from headline import COMPARISONS, THREE_SEEDS, read_scores

ALL = [*COMPARISONS.items(), *THREE_SEEDS.items()]


@pytest.mark.parametrize(("name", "comparison"), ALL, ids=[f"{name}, {comparison.steps}" for name, comparison in ALL])
def test_all_scores_can_be_read(name, comparison):
    """Ten seeds for each method of the headline."""
    references = comparison.episodic, comparison.dense
    methods = *references, *comparison.raw.values(), comparison.paper, comparison.default, comparison.without_phi
    n_seeds = {len(read_scores(sources, comparison)) for sources in methods if sources}
    assert n_seeds == {10 if COMPARISONS.get(name) is comparison else 3}
