import json

import pytest

from mops_lightning.errors import UserError
from tests.support.reports import put_cell, put_planes, rows, table


def test_axes_of_differing_settings_need_mixed(tmp_path):
    path = put_cell(tmp_path, "a", "mops", {"generated": 1.0})
    put_cell(tmp_path, "b", "snet", {"generated": 2.0}, batch_size=7)  # may differ by sampler
    assert len(rows(table(tmp_path))) == 3
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, "git": {"commit": "f" * 40, "dirty": False}}))
    with pytest.raises(UserError, match=r"differ in the commit of the code: .*ffffffffff.*--mixed"):
        table(tmp_path)
    assert len(rows(table(tmp_path, mixed=True))) == 3
    settings = {"learn": "sampler", "optimizer": {"name": "other"}}
    put_cell(tmp_path, "c", "mops", {"generated": 1.0}, m=8, **settings)
    assert rows(table(tmp_path, mixed=True))[0] == ["sampled by", "m=32", "m=8"]
    path.write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"\(mops: optimizer.name\).*--mixed"):
        table(tmp_path)


def test_axes_one_differing_setting_gives_columns(tmp_path):
    for noise in (0.0, 0.1, 0.02):
        values = {"generated": 1 + noise, "full": 0.5 + noise}
        put_cell(tmp_path, f"a{noise}", "mops", values, test_noise_std=noise)
        put_cell(tmp_path, f"b{noise}", "fps", {"sampled": 2 + noise}, test_noise_std=noise)
    assert rows(table(tmp_path)) == [
        ["sampled by", "test_noise_std=0.0", "test_noise_std=0.02", "test_noise_std=0.1"],
        ["fps", "2", "2.02", "2.1"],
        ["mops", "1", "1.02", "1.1"],
        ["all points", "0.5", "0.52", "0.6"],
    ]
    put_cell(tmp_path, "c", "mops", {"generated": 1.0}, test_noise_std=0.0, m=8)
    with pytest.raises(UserError, match=r"differ in size .* and in test_noise_std.*--mixed"):
        table(tmp_path)


def test_axes_mixed_sizes_and_settings_give_columns_by_size(tmp_path):
    put_cell(tmp_path, "a", "mops", {"generated": 1.0}, test_noise_std=0.0, m=32)
    put_cell(tmp_path, "b", "mops", {"generated": 2.0}, test_noise_std=0.1, m=8)
    assert rows(table(tmp_path, mixed=True))[:2] == [
        ["sampled by", "m=32", "m=8"],
        ["mops", "1", "2"],
    ]


def test_axes_two_differing_settings_give_plane_per_sampler(tmp_path):
    put_planes(tmp_path)
    text = table(tmp_path)
    assert "Test nre cd of samplenet" in text
    assert rows(text) == [
        ["beta \\ gamma", "1e-05", "0.001", "0.1"],
        ["0.1", "0.1 / 3", "0.101 / 3", "0.2 / 3"],
        ["1.0", "1 / 3", "1.001 / 3", "1.1 / 3"],
        ["alpha \\ tau", "0.5", "0.9"],
        ["0.1", "1 / 2", "1 / 2"],
        ["1.0", "1.5 / 2", "1.9 / 2"],
        ["window", "generated", "matched"],
        ["samplenet, beta 0.1 to 1, gamma 1e-05", "10", "1"],
        ["samplenet, beta 0.1 to 1, gamma 0.001", "9.91", "1"],
        ["samplenet, beta 0.1 to 1, gamma 0.1", "5.5", "1"],
        ["mops, alpha 0.1 to 1, tau 0.5 to 0.9", "1.9", "1"],
    ]
    assert "of mops: reconstruction on shapes, m=32, under autoencoder" in text
    assert "plane of mops: generated 1 to 1.9 (factor 1.9), matched 2 to 2 (factor 1)." in text


def test_axes_planes_of_several_sizes_are_refused(tmp_path):
    put_planes(tmp_path)
    put_cell(tmp_path, "other", "mops", {"generated": 1.0}, m=8, of={"alpha": 0.1, "tau": 0.7})
    with pytest.raises(UserError, match=r"differ in size \(m=8, m=32\) and in sampler.alpha"):
        table(tmp_path)
