import pytest

from tests.support.recording import CALLS


@pytest.fixture
def calls():
    """What the recording task is given during the test."""
    CALLS.clear()
    yield CALLS
    CALLS.clear()
