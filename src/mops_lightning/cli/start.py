"""What is checked before Hydra writes anything into the folder of a single run."""

from collections.abc import Sequence
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mops_lightning.config import distributed
from mops_lightning.config.explain import explain
from mops_lightning.config.paths import INPUTS, check_paths
from mops_lightning.errors import USER_ERROR, UserError, end, file_error
from mops_lightning.zoo import names


def begin(config: DictConfig, arguments: Sequence[str]) -> None:
    """Check the settings of a run and claim its folder, so that a refused run leaves nothing.

    Args:
        config: with Hydra's own settings.
        arguments: of the command line.

    Raises:
        SystemExit: a setting is wrong, or the folder contains a run; one line says so.
    """
    from mops_lightning.training.evaluation.trained_run import TrainedRun
    from mops_lightning.training.run import checked, claim

    HydraConfig.instance().set_config(config)  # the folder's name is made from it
    cfg = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
    try:
        folder = Path(config.hydra.run.dir)
        trained = TrainedRun.read(cfg.evaluate) if cfg.evaluate else None
        checked(cfg, trained, list(config.hydra.overrides.task))
        check_paths(cfg)
        _check_weights(cfg.weights)
        distributed.check_start(cfg, config.hydra.overrides.hydra)
        if not distributed.is_worker_rank(cfg):
            claim(folder)
    except (UserError, OmegaConfBaseException) as error:
        end("mops_lightning", explain(error, arguments), USER_ERROR)
    except OSError as error:
        end("mops_lightning", file_error(error), USER_ERROR)


def _check_weights(given: str | None) -> None:
    """Check that there is a file, run or model where ``weights`` names one.

    Raises:
        UserError: there is none.
    """
    if given is None or given in INPUTS["weights"]:
        return
    try:
        path = names.resolve(given)
    except UserError as error:
        raise UserError(f"weights: {error}") from None
    if not path.exists():
        raise UserError(
            f"weights: no file {path}. Give a weights.pt, a run, a model, or weights=auto."
        )


def make(folder: Path) -> None:
    """Make the folder of a sweep, or end the program.

    Raises:
        SystemExit: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        text = f"out: cannot write to {folder}: {error.strerror}."
        end("mops_lightning", text, USER_ERROR)
