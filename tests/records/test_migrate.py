import json

from mops_lightning.records import migrate, run_record
from tests.support.records import record


def test_new_path_of_a_renamed_setting_is_its_present_name():
    assert migrate.new_path("noise") == "test_noise_std"
    assert migrate.new_path("noise.level") == "test_noise_std.level"
    assert migrate.new_path("noisy") == "noisy"


def test_read_of_an_old_record_gives_present_names(tmp_path):
    old = record(config={"m": 32, "noise": 0.1, "task_rate": 0.5})
    (tmp_path / run_record.FILE).write_text(json.dumps(old))
    found = run_record.read(tmp_path)["config"]
    assert found == {"m": 32, "test_noise_std": 0.1, "task_lr_scale": 0.5}
