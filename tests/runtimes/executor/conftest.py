from collections.abc import Iterator

import pytest

from .simulation import workers


@pytest.fixture(autouse=True)
def _no_thread_is_left() -> Iterator[None]:
    assert workers() == []
    yield
    assert workers() == []
