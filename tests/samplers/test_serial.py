import torch

from mops_lightning.samplers.serial import SerialSampler, morton_codes


def plain_code(cell):
    """Interleave the bits of x, y and z, the highest first."""
    bits = "".join(
        bit for place in zip(*(f"{axis:021b}" for axis in cell), strict=True) for bit in place
    )
    return int(bits, 2)


def test_codes_interleave_the_bits_of_the_cells(rng):
    cells = torch.randint(2**21, (50, 3), generator=rng)
    cells[0], cells[1] = 0, 2**21 - 1  # the cube is the cloud's
    codes = morton_codes(cells.double()[None])[0].tolist()
    assert codes == [plain_code(cell) for cell in cells.tolist()]


def test_serial_takes_every_kth_point_along_the_curve(rng):
    points = torch.rand(2, 90, 3, generator=rng)
    indices = SerialSampler(9)(points).indices
    for codes, chosen in zip(morton_codes(points), indices, strict=True):
        assert codes[chosen].tolist() == codes.sort().values[5::10].tolist()


def test_serial_of_all_points_keeps_each_once():
    points = torch.tensor([[[1.0, 2.0, 3.0]] * 5, [[0.0, 0.0, 0.0]] * 4 + [[9.0, 9.0, 9.0]]])
    assert SerialSampler(5)(points).indices.sort(1).values.tolist() == [[0, 1, 2, 3, 4]] * 2
    assert SerialSampler(1)(points).indices.shape == (2, 1)


def test_serial_scales_all_axes_of_a_cloud_by_one_number():
    x = torch.arange(16.0)
    y = torch.tensor([0.0, 1e-3]).repeat(8)  # were it stretched to the length of x, it would lead
    rod = torch.stack([x, y, torch.zeros(16)], 1)

    indices = SerialSampler(4)(rod[None]).indices

    assert indices.tolist() == [[2, 6, 10, 14]]
