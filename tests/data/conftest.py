from pathlib import Path

import pytest

from tests.support.meshes import modelnet_layout


@pytest.fixture
def mesh_layout(tmp_path: Path) -> Path:
    return modelnet_layout(tmp_path)
