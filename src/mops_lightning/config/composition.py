"""Finding conf/ and composing a configuration from it, with Hydra's own errors."""

from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from mops_lightning.config import resolvers, settings  # noqa: F401, they register what conf/ uses
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


def composed(overrides: list[str]) -> DictConfig:
    """Compose a configuration; errors are those of Hydra, OmegaConf and YAML."""
    from hydra import compose, initialize_config_dir
    from hydra.core.hydra_config import HydraConfig

    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        cfg = compose("config", overrides=overrides, return_hydra_config=True)
    HydraConfig.instance().set_config(cfg)
    plain = OmegaConf.masked_copy(cfg, [str(key) for key in cfg if key != "hydra"])
    # Names come from Hydra's choices; resolved here they outlive the global HydraConfig.
    plain.names = OmegaConf.to_container(cfg.names, resolve=True)
    return plain
