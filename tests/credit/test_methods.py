import pytest

from lare_rl.credit.methods import METHODS, TABLE, Encoder, Fit, Reward, find_method
from lare_rl.errors import LareError


def test_names_are_unique():
    assert len(METHODS) == len(TABLE)


@pytest.mark.parametrize("method", TABLE, ids=lambda method: method.name)
def test_rows_are_whole(method):
    assert (method.reward is Reward.PROXY) == (method.fit is not None)
    assert (method.reward in (Reward.PROXY, Reward.DESIGNED)) == (method.encoder is not None)
    assert method.summary
    assert method.source


def test_published_rows():
    assert (METHODS["rd"].encoder, METHODS["rd"].fit) == (Encoder.RAW, Fit.ALL_STEPS)
    assert (METHODS["rrd"].encoder, METHODS["rrd"].fit) == (Encoder.RAW, Fit.DRAWN_STEPS)
    assert (METHODS["rrdu"].encoder, METHODS["rrdu"].fit) == (Encoder.RAW, Fit.DRAWN_STEPS_UNBIASED)
    assert (METHODS["lare-rd"].encoder, METHODS["lare-rd"].fit) == (Encoder.LATENT, Fit.ALL_STEPS)
    assert (METHODS["lare-rrdu"].encoder, METHODS["lare-rrdu"].fit) == (Encoder.LATENT, Fit.DRAWN_STEPS_UNBIASED)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("lare_rrdu", "no method 'lare_rrdu' (did you mean 'lare-rrdu'?)"),
        ("", "no method ''"),
    ],
)
def test_unknown_method(name, message):
    with pytest.raises(LareError) as caught:
        find_method(name)
    assert str(caught.value) == f"{message}; the methods are {', '.join(METHODS)}"
