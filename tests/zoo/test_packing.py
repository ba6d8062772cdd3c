import pytest
import torch

from mops_lightning.zoo.packing import pack, unpack


def test_pack_rounds_to_127_steps_of_each_row():
    weight = torch.tensor([[1.27, -0.5, 0.0], [0.0, 0.0, 0.0], [-254.0, 2.9, 127.0]])
    packed = pack("w", weight)
    assert packed["w"].tolist() == [[127, -50, 0], [0, 0, 0], [-127, 1, 64]]
    torch.testing.assert_close(packed["w.scale"], torch.tensor([0.01, 0.0, 2.0]))


def test_pack_of_unpacked_gives_the_same():
    packed = pack("w", torch.randn(40, 30) * torch.rand(40, 1) * 100)
    again = pack("w", unpack(packed)["w"])
    assert torch.equal(again["w"], packed["w"])


def test_unpack_keeps_other_tensors():
    state = {"b": torch.randn(3), "n": torch.tensor(4), **pack("w", torch.randn(2, 3))}
    found = unpack(state)
    assert set(found) == {"b", "n", "w"}
    assert found["b"] is state["b"]
    assert found["w"].dtype == torch.float32


@pytest.mark.parametrize("scale", [None, torch.ones(3), torch.ones(2, 1)])
def test_unpack_without_a_scale_for_every_row_raises(scale):
    state = {"w": torch.ones(2, 3, dtype=torch.int8), "w.scale": scale}
    with pytest.raises(ValueError, match="w has no scale"):
        unpack({name: value for name, value in state.items() if value is not None})
