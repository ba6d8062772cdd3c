"""Finding conf/ and composing a configuration from it."""

from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mops_lightning.config import resolvers  # noqa: F401, registers what conf/ uses
from mops_lightning.config.validate import misfit_of
from mops_lightning.errors import UserError


def conf_dir() -> Path:
    """Return the folder with the Hydra groups: in the wheel, or at the top of a checkout.

    Raises:
        UserError: neither is there; the installation is broken.
    """
    here = Path(__file__).resolve().parents[1]
    for folder in (here / "conf", here.parents[1] / "conf"):
        if (folder / "config.yaml").is_file():
            return folder
    raise UserError(
        f"conf/ is neither in {here} nor next to src/: reinstall with "
        "pip install --force-reinstall mops-lightning."
    )


def compose(overrides: list[str] | None = None) -> DictConfig:
    """Compose a configuration as the command line does, for notebooks and tests.

    Args:
        overrides: such as ``["m=64", "sampler=fps"]``.

    Raises:
        UserError: a run-level setting has a value of another type.
    """
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.core.hydra_config import HydraConfig
    from hydra.errors import HydraException

    try:
        with initialize_config_dir(str(conf_dir()), version_base="1.3"):
            cfg = hydra_compose("config", overrides=overrides or [], return_hydra_config=True)
    except (HydraException, OmegaConfBaseException) as error:
        refused = misfit_of(error)
        if refused is None:
            raise
        raise refused from None
    HydraConfig.instance().set_config(cfg)
    plain = OmegaConf.masked_copy(cfg, [str(key) for key in cfg if key != "hydra"])
    # Names come from Hydra's choices; resolved here they outlive the global HydraConfig.
    plain.names = OmegaConf.to_container(cfg.names, resolve=True)
    return plain
