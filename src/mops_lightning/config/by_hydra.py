"""Hydra's composition of the files in ``conf/``, whose errors are Hydra's own; see ``compose``.

The import of this module makes the settings known to Hydra, and the resolvers to OmegaConf.
"""

from omegaconf import DictConfig, OmegaConf

from mops_lightning.config import labels, settings
from mops_lightning.config.groups import conf_dir


def composed(overrides: list[str]) -> DictConfig:
    """Compose a configuration; errors are raised by Hydra, OmegaConf and YAML."""
    from hydra import compose as compose_by_hydra
    from hydra import initialize_config_dir
    from hydra.core.hydra_config import HydraConfig

    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        cfg = compose_by_hydra("config", overrides=overrides, return_hydra_config=True)
    HydraConfig.instance().set_config(cfg)
    own_keys = [str(key) for key in cfg if key != "hydra"]
    plain = OmegaConf.masked_copy(cfg, own_keys)
    # Names come from Hydra's choices; resolved here they outlive the global HydraConfig.
    plain.names = OmegaConf.to_container(cfg.names, resolve=True)
    return plain


settings.register()
labels.register()
