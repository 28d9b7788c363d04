"""What a wrong input ends in: one sentence."""

from contextlib import contextmanager

import pytest

from ocp_torch.errors import InputError


@contextmanager
def refused(words: str):
    """Expects an `InputError` whose message matches ``words`` and is one sentence on one line."""
    with pytest.raises(InputError, match=words) as caught:
        yield
    assert "\n" not in str(caught.value)
    assert str(caught.value).endswith(".")
