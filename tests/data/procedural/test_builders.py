import numpy as np
import pytest

from mops_lightning.data.procedural.builders import BUILDERS


@pytest.mark.parametrize("name", BUILDERS)
def test_builder_gives_valid_meshes(name: str) -> None:
    for seed in range(12):
        mesh = BUILDERS[name](np.random.default_rng(seed))
        assert np.isfinite(mesh.vertices).all()
        assert mesh.faces.max() < len(mesh.vertices)
        assert (mesh.extents > 0.1).all()
        assert mesh.extents.max() < 4
