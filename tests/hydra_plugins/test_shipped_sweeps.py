"""The sweeps of the package on Hydra's search path."""

from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra

from mops_lightning.config.groups import conf_dir, sweeps_dir
from tests.support.command_line import refused


def search_path(folder):
    with initialize_config_dir(str(folder), version_base="1.3"):
        found = GlobalHydra.instance().config_loader().get_search_path().get_path()
        return [entry.path for entry in found]


def test_search_path_of_this_program_ends_in_the_sweeps():
    paths = search_path(conf_dir())

    assert paths[-2:] == [f"file://{sweeps_dir()}", "structured://"]


def test_search_path_of_another_program_is_left_alone(tmp_path):
    assert not any("sweeps" in path for path in search_path(tmp_path))


def test_mistyped_name_of_a_sweep_names_the_nearest(tmp_path):
    said = refused(["-m", "--config-name", "ablatoin"], tmp_path)

    assert "--config-name ablatoin: no such file" in said
    assert "Did you mean 'ablation'" in said
