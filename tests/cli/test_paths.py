import pytest
from omegaconf import OmegaConf

from mops_lightning.cli.start import INPUTS, OUTPUTS, check_paths
from mops_lightning.config.compose import compose
from mops_lightning.errors import UserError


@pytest.mark.parametrize("name", ["out", "cache", "weights", "ckpt_path", "dataset.cache"])
@pytest.mark.parametrize(
    ("value", "said"),
    [
        ("n" * 300, r"n \.\.\. \(300 characters\): File name too long"),
        ("loop/below", "loop/below: Too many levels of symbolic links"),
        ("file/below", "file/below: Not a directory"),
    ],
    ids=["long", "loop", "file"],
)
def test_check_paths_impossible_path_names_setting(name, value, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=f"^{name}: .*{said}"):
        check_paths(compose([f"{name}={value}"]))


@pytest.mark.parametrize("name", [*INPUTS, *OUTPUTS])
def test_check_paths_empty_path_is_not_the_current_folder(name):
    cfg = OmegaConf.create()
    OmegaConf.update(cfg, name, "")
    with pytest.raises(
        UserError, match=rf"^{name}: no path is given\. Give one, or leave {name} out"
    ):
        check_paths(cfg)


def test_check_paths_missing_checkpoint_raises(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=r"^ckpt_path: no checkpoint nowhere\.pt\. Give"):
        check_paths(compose(["ckpt_path=nowhere.pt"]))
    check_paths(compose(["out=new", "cache=new"]))
