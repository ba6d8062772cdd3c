import pytest

from mops_lightning.ops import compiled


@pytest.fixture(params=["compiled", "torch"])
def farthest_form(request, monkeypatch):
    """Farthest points by the compiled loops, and by torch, as on a GPU."""
    if request.param == "torch":
        monkeypatch.setattr(compiled, "farthest", lambda *_: None)
