"""Seeds, other settings than the size, heat maps, and the files that a report consists of."""

import csv
import json
from typing import Any

import pytest
import torch
from matplotlib.colors import LogNorm, Normalize

from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from mops_lightning.report.build import build
from mops_lightning.report.cli import main
from mops_lightning.report.plots import plots
from mops_lightning.viz.snapshots import save_clouds
from tests.support.reports import put, put_cell, put_planes, rows, table


def test_seeds_are_summed_up_with_their_count(tmp_path):
    for seed, value in enumerate((1.0, 2.0, 3.0)):
        put_cell(tmp_path, f"{seed}", "mops", {"generated": value, "matched": 1.5}, seed=seed)
    assert rows(table(tmp_path))[1] == ["mops", "2 ± 1.00 / 1.5 ± 0.00 (n=3)"]
    put_cell(tmp_path, "again", "mops", {"generated": 1.0}, seed=2)
    with pytest.raises(UserError, match="Two runs of mops with m=32 and seed=2"):
        table(tmp_path)


def test_runs_of_other_commits_or_settings_stand_together_only_when_asked(tmp_path):
    path = put_cell(tmp_path, "a", "mops", {"generated": 1.0})
    put_cell(tmp_path, "b", "snet", {"generated": 2.0}, batch_size=7)  # its own business
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


def test_one_more_setting_makes_columns(tmp_path):
    for noise in (0.0, 0.1, 0.02):
        figures = {"generated": 1 + noise, "full": 0.5 + noise}
        put_cell(tmp_path, f"a{noise}", "mops", figures, noise=noise)
        put_cell(tmp_path, f"b{noise}", "fps", {"sampled": 2 + noise}, noise=noise)
    assert rows(table(tmp_path)) == [
        ["sampled by", "noise=0.0", "noise=0.02", "noise=0.1"],
        ["fps", "2", "2.02", "2.1"],
        ["mops", "1", "1.02", "1.1"],
        ["all points", "0.5", "0.52", "0.6"],
    ]
    put_cell(tmp_path, "c", "mops", {"generated": 1.0}, noise=0.0, m=8)
    with pytest.raises(UserError, match=r"differ in size \(m=8, m=32\) and in noise.*--mixed"):
        table(tmp_path)


def test_sizes_of_different_kinds_stand_beside_each_other_if_asked(tmp_path):
    put_cell(tmp_path, "a", "mops", {"generated": 1.0}, noise=0.0, m=32)
    put_cell(tmp_path, "b", "mops", {"generated": 2.0}, noise=0.1, m=8)
    assert rows(table(tmp_path, mixed=True))[:2] == [
        ["sampled by", "m=32", "m=8"],
        ["mops", "1", "2"],
    ]


@pytest.mark.parametrize(("far", "kind"), [(3.0, Normalize), (12000.0, LogNorm)])
def test_colours_are_logarithmic_where_one_figure_would_hide_the_rest(far, kind, tmp_path):
    for sampler, keys in (("mops", ("alpha", "tau")), ("samplenet", ("beta", "gamma"))):
        for down, across in ((1, 1), (1, 2), (2, 1), (2, 2)):
            corner = sampler == "samplenet" and down + across == 4
            values = {"generated": far if corner else 1.0 + across, "matched": 2.0}
            settings = dict(zip(keys, (down, across), strict=True))
            put_cell(tmp_path, f"{sampler}{down}{across}", sampler, values, of=settings)
    figure = plots(build(tmp_path))["nre_cd_planes"]
    images = [image for axis in figure.axes for image in axis.images]
    assert {type(image.norm) for image in images} == {kind}
    assert len({(image.norm.vmin, image.norm.vmax) for image in images}) == 1, "one for all"
    texts = [text.get_text() for axis in figure.axes for text in axis.texts]
    assert ("12,000" if kind is LogNorm else "3") in texts


def test_two_settings_make_a_plane_for_each_sampler(tmp_path):
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
    ]
    assert "of mops: reconstruction on shapes, m=32, under autoencoder" in text
    assert "plane of mops: generated 1 to 1.9 (factor 1.9), matched 2 to 2 (factor 1)." in text


def test_planes_of_several_sizes_are_refused(tmp_path):
    put_planes(tmp_path)
    put_cell(tmp_path, "other", "mops", {"generated": 1.0}, m=8, of={"alpha": 0.1, "tau": 0.7})
    with pytest.raises(UserError, match=r"differ in size \(m=8, m=32\) and in sampler.alpha"):
        table(tmp_path)


def test_each_seed_may_have_data_of_its_own_if_every_sampler_has_every_seed(tmp_path):
    for seed in (0, 1):
        for name in ("mops", "fps"):
            values = {"generated": 1.0 + seed}
            path = put_cell(tmp_path, f"{name}{seed}", name, values, seed=seed)
            content = json.loads(path.read_text())
            content["notes"] |= {
                "dataset_fingerprint": f"d{seed}",
                "task_weights_sha256": f"w{seed}",
            }
            path.write_text(json.dumps(content))
    assert rows(table(tmp_path))[1] == ["fps", "1.5 ± 0.71 (n=2)"]
    path.parent.joinpath(run_record.FILE).unlink()
    with pytest.raises(UserError, match="every sampler must have every seed"):
        table(tmp_path)


def test_cells_without_a_result_are_listed_with_the_reason(tmp_path):
    put_cell(tmp_path, "done", "mops", {"generated": 1.0})
    (tmp_path / "failed").mkdir()
    (tmp_path / "failed" / ".failed").write_text("m must be at most 64\n")
    put_cell(tmp_path / "done", ".attempts/1", "mops", {"generated": 9.0})
    text = table(tmp_path)
    assert "1 of 2 runs are not completed:" in text
    assert f"- {tmp_path}/failed: m must be at most 64" in text
    assert "9" not in rows(text)[1][1]


def test_all_files_are_written_and_say_the_same(tmp_path, capsys):
    put_planes(tmp_path)
    main([str(tmp_path)])
    assert "nre_cd_planes.png" in capsys.readouterr().out
    assert (tmp_path / "nre_cd_planes.png").read_bytes()[:4] == b"\x89PNG"
    svg = (tmp_path / "nre_cd_planes.svg").read_text()
    assert "samplenet" in svg or "<path" in svg
    tex = (tmp_path / "table.tex").read_text()
    assert r"1.0 & 1.5 / 2 & 1.9 / 2 \\" in tex
    assert tex.count(r"\begin{tabular}") == tex.count(r"\end{tabular}") == 2
    with (tmp_path / "table.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 20
    (one,) = [
        line
        for line in lines
        if (line["sampler.alpha"], line["sampler.tau"], line["readout"])
        == ("1.0", "0.9", "generated")
    ]
    assert (one["sampler"], one["metric"], one["value"], one["m"]) == (
        "mops",
        "nre_cd",
        "1.9",
        "32",
    )


def test_sizes_are_drawn_as_curves(tmp_path):
    for m in (8, 32):
        put(tmp_path, "fps", m, {"test/sampled/accuracy": m / 100})
        put(tmp_path, "mops", m, {"test/generated/accuracy": m / 50, "test/matched/accuracy": 0.5})
    (figure,) = plots(build(tmp_path)).values()
    panels: list[list[Any]] = [list(axes.containers) for axes in figure.axes]
    first, second, third = panels
    fps, mops = first
    assert fps.lines[0].get_ydata().tolist() == [8, 32]
    assert mops.lines[0].get_ydata().tolist() == [16, 64]
    assert second[1].lines[0].get_ydata().tolist() == [50, 50]
    assert len(third) == 1  # there are no completed figures of MOPS-Net


def test_a_cloud_is_drawn_at_every_noise_level(tmp_path, rng):
    for noise in (0.0, 0.1):
        for name, readout in (("mops", "generated"), ("fps", "sampled")):
            path = put_cell(tmp_path, f"{name}{noise}", name, {readout: 1.0}, noise=noise)
            content = json.loads(path.read_text())
            path.write_text(json.dumps({**content, "files": {"clouds": "clouds.npz"}}))
            points = torch.rand(1, 40, 3, generator=rng)
            save_clouds(path.parent / "clouds.npz", points, {readout: points[:, :4]}, ["chair"])
    figure = plots(build(tmp_path))["clouds"]
    assert [axes.get_title() for axes in figure.axes[:2]] == ["noise=0", "noise=0.1"]
    assert len(figure.axes) == 4


def test_runs_of_one_sampler_made_in_several_ways_are_named(tmp_path):
    values = {"generated": 1.0, "matched": 1.5}
    for name, m, length in (("short-8", 8, 3), ("short-16", 16, 3), ("long", 32, 9)):
        put_cell(tmp_path, name, "mops", values, m=m, trainer={"max_epochs": length})
    put_cell(tmp_path, "other", "samplenet", values, m=8, trainer={"max_epochs": 9})
    text = table(tmp_path, mixed=True)
    assert "- mops (short-16, short-8): 3 epochs, seed 0" in text
    assert "- mops (long): 9 epochs, seed 0" in text
    assert "- samplenet: 9 epochs, seed 0" in text
