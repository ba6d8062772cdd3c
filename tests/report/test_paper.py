import pytest

from mops_lightning.report import paper

SIZES = {
    "classification": {"512", "256", "128", "64", "32", "16", "8"},
    "registration": {"64", "32", "8"},
    "registration_joint": {"64", "32", "8"},
    "large_nre_cd": {"4096", "1024", "256"},
    "large_nre_emd": {"4096", "1024", "256"},
}


@pytest.mark.parametrize("name", SIZES)
def test_published_tables_are_complete(name):
    assert set(paper.published_tables()) == {*SIZES, "frameworks"}
    for sampler, sizes in paper.published_tables()[name]["rows"].items():
        assert set(sizes) == SIZES[name]
        count = 1 if sampler in ("random", "voxel", "fps") or "large" in name else 3
        assert {len(values) for values in sizes.values()} == {count}
