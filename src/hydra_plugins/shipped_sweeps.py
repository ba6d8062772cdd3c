"""The sweeps of the package are found by ``--config-name`` alone, also from the wheel."""

from hydra.core.config_search_path import ConfigSearchPath
from hydra.plugins.search_path_plugin import SearchPathPlugin

from mops_lightning.config.groups import conf_dir, sweeps_dir


class ShippedSweeps(SearchPathPlugin):
    """Adds the folder of sweeps to the search path of this program, not of other programs."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Append the folder.

        Args:
            search_path: where Hydra looks for configurations; changed in place.
        """
        conf = conf_dir()
        known = {entry.path for entry in search_path.get_path()}
        is_this_program = f"file://{conf}" in known or str(conf) in known
        if is_this_program:
            search_path.append("mops_lightning", f"file://{sweeps_dir()}")
