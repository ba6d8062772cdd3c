import numpy as np
import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.viz.figures import MAX_INPUT_POINTS, load_clouds, save_clouds


def test_save_clouds_large_thins_input_and_keeps_samples(tmp_path, rng):
    points = torch.rand(2, 20_000, 3, generator=rng)
    save_clouds(tmp_path / "clouds.npz", points, {"generated": points[:, :4096]}, ["a", "b"])
    titles, arrays = load_clouds(tmp_path / "clouds.npz")
    assert titles == ["a", "b"]
    assert list(arrays) == ["input", "generated"]
    assert arrays["input"].shape[1] <= MAX_INPUT_POINTS
    assert torch.equal(torch.from_numpy(arrays["generated"]), points[:, :4096])


DAMAGES: dict[str, dict[str, np.ndarray]] = {
    "cut": {},
    "text": {},
    "no samples": {},
    "objects": {"generated": np.array([{}, {}], dtype=object)},
    "nan": {"generated": np.full((2, 4, 3), np.nan, np.float32)},
    "flat": {"input": np.zeros((2, 3), np.float32)},
    "flat samples": {"generated": np.zeros((2, 3))},
    "texts": {"generated": np.zeros((2, 3, 3), "U1")},
    "one title": {"titles": np.array(["a"])},
    "no letters": {"titles": np.array([0x7FFFFFFF] * 2, "<u4").view("<U1")},
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_load_clouds_damaged_file_is_refused(tmp_path, rng, damage):
    path = tmp_path / "clouds.npz"
    points = torch.rand(2, 50, 3, generator=rng)
    save_clouds(path, points, {"generated": points[:, :4]}, ["a", "b"])
    arrays = {**np.load(path), **DAMAGES[damage]}
    if damage == "no samples":
        del arrays["generated"]
    np.savez(path, **arrays)
    if damage in ("cut", "text"):
        path.write_bytes(path.read_bytes()[:-200] if damage == "cut" else b"text")
    with pytest.raises(UserError, match=r"clouds\.npz: cannot read saved clouds: .+\.$"):
        load_clouds(path)
