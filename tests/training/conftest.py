from collections.abc import Iterator

import pytest

from tests.support.recording import Call, recorded_calls


@pytest.fixture
def calls() -> Iterator[list[Call]]:
    """What the recording task is given during the test."""
    with recorded_calls() as found:
        yield found
