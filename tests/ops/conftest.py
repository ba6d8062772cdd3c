import pytest

from mops_lightning.ops import compiled, points


@pytest.fixture(params=[0, points.PLAIN_MAX_VALUES], ids=["blocked", "plain"])
def argextreme_path(request, monkeypatch):
    """Small inputs through both code paths of ``blocked_argextreme``."""
    monkeypatch.setattr(points, "PLAIN_MAX_VALUES", request.param)


@pytest.fixture(params=["compiled", "torch"])
def farthest_form(request, monkeypatch):
    """Farthest points by the compiled loops, and by torch, as on a GPU."""
    if request.param == "torch":
        monkeypatch.setattr(compiled, "farthest", lambda *_: None)
