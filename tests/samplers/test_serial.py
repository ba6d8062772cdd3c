import torch

from mops_lightning.samplers.serial import SerialSampler, morton_codes


def plain_code(cell):
    """Interleave the bits of x, y and z, the highest first."""
    x, y, z = (f"{axis:021b}" for axis in cell)
    bits = ""
    for bits_of_place in zip(x, y, z, strict=True):
        bits += "".join(bits_of_place)
    return int(bits, 2)


def test_codes_interleave_the_bits_of_the_cells(rng):
    cells = torch.randint(2**21, (50, 3), generator=rng)
    cells[0] = 0
    cells[1] = 2**21 - 1  # the cube is the cloud's

    (codes,) = morton_codes(cells.double()[None])

    expected = [plain_code(cell) for cell in cells.tolist()]
    assert codes.tolist() == expected


def test_serial_takes_every_kth_point_along_the_curve(rand):
    points = rand(2, 90, 3)

    indices = SerialSampler(9)(points).indices

    codes = morton_codes(points)
    for codes_of_cloud, rows in zip(codes, indices, strict=True):
        along_curve, _ = codes_of_cloud.sort()
        assert torch.equal(codes_of_cloud[rows], along_curve[5::10])


def test_serial_of_all_points_keeps_each_once():
    equal = torch.tensor([1.0, 2.0, 3.0]).repeat(5, 1)
    with_outlier = torch.zeros(5, 3)
    with_outlier[4] = 9.0
    points = torch.stack([equal, with_outlier])

    of_equal, of_outlier = SerialSampler(5)(points).indices.tolist()

    assert sorted(of_equal) == [0, 1, 2, 3, 4]
    assert sorted(of_outlier) == [0, 1, 2, 3, 4]


def test_serial_scales_all_axes_of_a_cloud_by_one_number():
    x = torch.arange(16.0)
    y = torch.tensor([0.0, 1e-3]).repeat(8)  # were it stretched to the length of x, it would lead
    rod = torch.stack([x, y, torch.zeros(16)], 1)

    indices = SerialSampler(4)(rod[None]).indices

    assert indices.tolist() == [[2, 6, 10, 14]]


def test_serial_of_one_point_has_one_row_a_cloud():
    points = torch.zeros(2, 5, 3)

    rows = SerialSampler(1)(points).indices

    assert rows.shape == (2, 1)
