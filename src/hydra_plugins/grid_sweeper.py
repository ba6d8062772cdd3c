"""``hydra/sweeper=grid``: several products of settings in one sweep.

Hydra finds plugins in the namespace package ``hydra_plugins``, which has no ``__init__.py``.
"""

from dataclasses import dataclass
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper, BasicSweeperConf
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import OmegaConf

GRIDS = "hydra.sweeper.grids"


@dataclass
class GridSweeperConf(BasicSweeperConf):
    """The sweeper's settings: BasicSweeper's, and the grids."""

    _target_: str = "hydra_plugins.grid_sweeper.GridSweeper"
    _recursive_: bool = False  # what was escaped (\${...}) is for the cells
    grids: Any = None


ConfigStore.instance().store(group="hydra/sweeper", name="grid", node=GridSweeperConf)


class GridSweeper(BasicSweeper):
    r"""Runs grids one after the other; the cells of a grid are the product of its values.

    Args:
        max_batch_size: largest number of cells that the launcher gets at once.
        params: overrides for all grids, as for ``BasicSweeper``.
        grids: list of mappings from an override to a value, or to several values with commas
            between them. A grid wins over ``params``, the command line over both. An escaped
            interpolation, ``\${seed}``, is resolved in the cell.
    """

    def __init__(self, max_batch_size: int | None, params: Any = None, grids: Any = None) -> None:
        super().__init__(max_batch_size, params)
        self.params = _plain(self.params)
        self.grids = _plain(grids)

    def _parse_config(self) -> list[str]:
        return []  # ``params`` are added to each grid, so that a grid wins over them

    def split_arguments(  # type: ignore[override]
        self, overrides: list[Override], max_batch_size: int | None
    ) -> list[list[list[str]]]:
        """Return the batches of cells; a grid starts only when the grid before it has ended.

        Args:
            overrides: of the command line.
            max_batch_size: largest number of cells in a batch.

        Raises:
            HydraException: a grid is wrong. All are checked before the first one starts.
        """
        if not isinstance(self.grids, list) or not self.grids:
            raise HydraException(f"{GRIDS} must be a list of mappings, got {self.grids!r}.")
        batches = []
        for number, grid in enumerate(self.grids):
            if not isinstance(grid, dict):
                raise HydraException(f"{GRIDS}[{number}] must be a mapping, got {grid!r}.")
            own = parsed({**self.params, **grid}, f"{GRIDS}[{number}]")
            batches += super().split_arguments([*own, *overrides], max_batch_size)
        for batch in batches[1:]:  # Hydra checks a batch when it starts
            self.validate_batch_is_legal(batch)
        return batches


def parsed(settings: dict[str, Any], place: str) -> list[Override]:
    """Return the overrides of a grid; ``place`` names it in errors."""
    parser = OverridesParser.create()
    overrides = []
    for key, value in settings.items():
        text = "null"
        if value is not None:
            text = str(value)
        try:
            overrides.append(parser.parse_override(f"{key}={text}"))
        except HydraException:
            raise HydraException(
                f"{place}: cannot read {key}={text}. Give one value, or several with "
                "commas between them."
            ) from None
    return overrides


def _plain(node: Any) -> Any:
    if not OmegaConf.is_config(node):
        return node
    return OmegaConf.to_container(node, resolve=False)
