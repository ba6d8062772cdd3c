from tests.support.reports import put, put_cell, put_pairs, table


def test_provenance_several_ways_name_runs(tmp_path):
    values = {"generated": 1.0, "matched": 1.5}
    for name, m, length in (("short-8", 8, 3), ("short-16", 16, 3), ("long", 32, 9)):
        put_cell(tmp_path, name, "mops", values, m=m, trainer={"max_epochs": length})
    put_cell(tmp_path, "other", "samplenet", values, m=8, trainer={"max_epochs": 9})
    text = table(tmp_path, mixed=True)
    assert "- mops (short-16, short-8): 3 epochs, seed 0" in text
    assert "- mops (long): 9 epochs, seed 0" in text
    assert "- samplenet: 9 epochs, seed 0" in text


def test_provenance_hides_other_tasks_and_names_other_nets(tmp_path):
    put_pairs(tmp_path, "fps", 32, 12.0)
    put_pairs(tmp_path, "fps", 32, 20.0, net="icp")
    put(tmp_path, "snet", 32, {"test/full/accuracy": 0.9})
    path = tmp_path / "snet-32-pointnet" / "result.json"
    path.write_text(path.read_text().replace('"learn": "sampler"', '"learn": "task"'))
    text = table(tmp_path)
    assert "pointnet" not in text
    assert "- fps under icp: nothing to train" in text
    assert "- fps: nothing to train" in text
