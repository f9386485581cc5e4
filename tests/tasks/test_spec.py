import pytest

from helpers.toys import toy_spec


@pytest.mark.parametrize("key", ["name", "description", "observation", "action", "environment"])
def test_the_digest_follows_every_text(key):
    assert toy_spec().digest == toy_spec().digest
    assert toy_spec(**{key: "another"}).digest != toy_spec().digest
