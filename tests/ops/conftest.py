import pytest

from mops_lightning.ops import extreme


@pytest.fixture(params=[0, extreme.PLAIN_MAX_VALUES], ids=["blocked", "plain"])
def argextreme_path(request, monkeypatch):
    """Small inputs through both code paths of ``blocked_argextreme``."""
    monkeypatch.setattr(extreme, "PLAIN_MAX_VALUES", request.param)
