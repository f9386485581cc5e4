"""Functions that all runs of a process share."""

from dataclasses import dataclass

import numpy as np

from helpers.small_configs import small_config
from helpers.toy_envs import PHI, toy_spec
from lare_rl.latent.function import verify_function
from lare_rl.training import compile_cache
from lare_rl.training.compile_cache import cache_by_value, clear_compile_cache
from lare_rl.training.compiled import compile_functions


@dataclass(frozen=True, eq=False)
class Static:
    value: object


@cache_by_value
def build(static, option=0):
    return object()


def test_only_equal_arguments_share_a_result_until_it_is_forgotten():
    assert build(Static(np.arange(3))) is build(Static(np.arange(3)), option=0)
    assert build(Static({"a": (1, [2.0])})) is build(Static({"a": (1, [2.0])}))
    values = (1, 1.0, True, "1", None, (1,), [1], np.arange(3), np.arange(3.0), np.arange(3).reshape(3, 1))
    assert len({id(build(Static(value))) for value in values}) == len(values)
    assert build(Static(1)) is not build(Static(1), option=1)
    clear_compile_cache()
    first = build(0)
    for i in range(1, compile_cache.MAX_ENTRIES):
        build(i)
        assert build(0) is first
    results = [build(i) for i in range(2 * compile_cache.MAX_ENTRIES)]  # keeps them alive, so that ids differ
    assert build(0) is not first
    assert results


def test_run_shares_functions_but_not_phi():
    graph, same_graph, other = (
        verify_function(source, toy_spec()).graph
        for source in (PHI, PHI, "def evaluation_func(o, a):\n    return [o[:, 0:1], a]\n")
    )
    functions = compile_functions(small_config("lare-rrdu"), (graph,))
    assert compile_functions(small_config("lare-rrdu"), (same_graph,)) is functions
    other_phi = compile_functions(small_config("lare-rrdu"), (other,))
    assert (other_phi.fit, other_phi.train_step) == (functions.fit, functions.train_step)
    assert other_phi.store is not functions.store
