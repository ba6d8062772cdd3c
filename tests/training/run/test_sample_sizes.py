import pytest

from mops_lightning import FMOPSNet, FPSSampler, MOPSNet
from mops_lightning.errors import UserError
from mops_lightning.training.run.sample_sizes import sizes_to_test


@pytest.mark.parametrize(
    ("sizes", "m", "sampler", "expected"),
    [
        ("auto", 32, FMOPSNet(512), (8, 16, 32, 64, 128, 256, 512)),
        ("auto", 20, FMOPSNet(100), (8, 16, 20, 32, 64)),
        ("auto", 32, MOPSNet(32), (32,)),
        ("auto", 32, FPSSampler(32), (32,)),
        ([64, 8], 32, FPSSampler(32), (8, 32, 64)),
        ([64, 8, 8], 8, FMOPSNet(100), (8, 64)),
        ([32], 32, MOPSNet(32), (32,)),
        ("auto", 32, None, ()),
    ],
)
def test_sizes_to_test_returns_ascending_sizes(sizes, m, sampler, expected):
    assert sizes_to_test(sizes, m, sampler, 1024) == expected


def test_sizes_to_test_up_to_all_points_of_a_cloud_are_taken():
    assert sizes_to_test([100], 100, FPSSampler(100), 100) == (100,)
    assert sizes_to_test("auto", 64, FMOPSNet(64), 64) == (8, 16, 32, 64)


def test_sizes_to_test_of_a_trained_sampler_may_be_below_its_largest():
    sampler = FMOPSNet(512)

    assert sizes_to_test("auto", 32, sampler, 200, training=False) == (8, 16, 32, 64, 128)
    with pytest.raises(UserError, match="m must be at most the 200 points of a cloud, got 201"):
        sizes_to_test("auto", 201, sampler, 200, training=False)


@pytest.mark.parametrize(
    ("sizes", "m", "sampler", "named"),
    [
        ([8], 32, MOPSNet(32), r"returns 32 points.*got sizes=\[8\]"),
        ([101], 32, FMOPSNet(100), "sizes must be at most sampler.m_max=100, got 101"),
        ([201], 32, FPSSampler(32), "sizes must be at most the 200 points of a cloud, got 201"),
        ("auto", 101, FMOPSNet(100), "m must be at most sampler.m_max=100, got 101"),
        ("auto", 32, FMOPSNet(512), "sampler.m_max must be at most the 200 points .* got 512"),
    ],
)
def test_sizes_to_test_out_of_range_raises(sizes, m, sampler, named):
    with pytest.raises(UserError, match=named):
        sizes_to_test(sizes, m, sampler, 200)
