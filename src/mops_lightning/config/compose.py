"""Composing a configuration from the folder ``conf/``, as the command line does."""

from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError  # type: ignore[import-untyped]

from mops_lightning.config.by_hydra import composed
from mops_lightning.config.check_overrides import check_overrides
from mops_lightning.config.explain import explain
from mops_lightning.config.overrides import with_own_classes
from mops_lightning.errors import UserError


def compose(overrides: list[str] | None = None) -> DictConfig:
    """Compose a configuration as the command line does, for notebooks and tests.

    Args:
        overrides: such as ``["m=64", "sampler=fps"]``.

    Raises:
        UserError: an unknown setting or choice, or a value of another type than the setting's.
    """
    from hydra.errors import HydraException

    given = with_own_classes(overrides or [])
    check_overrides(given)
    try:
        return composed(given)
    except (HydraException, OmegaConfBaseException, YAMLError, UnicodeDecodeError) as error:
        raise UserError(explain(error, given)) from None
