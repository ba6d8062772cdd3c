"""Model files: tensors in the safetensors format, with a card in the header.

Listing cards needs neither torch nor the tensors.
"""

import json
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mops_lightning.errors import UserError
from mops_lightning.filesystem import atomic_write
from mops_lightning.records import run_record
from mops_lightning.zoo.digest import digest

if TYPE_CHECKING:
    from torch import Tensor

SCHEMA = "mops_lightning/model/1"
SUFFIX = ".safetensors"
KEY = "mops_lightning"
"""Key of the card in the header; safetensors writes several keys in random order."""


def write(path: Path, card: dict[str, Any], state: "dict[str, Tensor]") -> None:
    """Write a model file; an existing one is replaced atomically.

    Args:
        path: the file.
        card: see ``card.schema.json``, without ``schema`` and ``sha256``, which are added.
        state: tensors by name.

    Raises:
        jsonschema.ValidationError: the card does not fit its schema: a bug in this program.
    """
    import jsonschema
    from safetensors.torch import save_file

    card = {"schema": SCHEMA, **card, "sha256": digest(state)}
    jsonschema.validate(card, schema())
    with atomic_write(path) as temporary:
        save_file(state, temporary, metadata={KEY: json.dumps(card, allow_nan=False)})


def read(path: Path) -> dict[str, Any]:
    """Read a model file and verify its tensors.

    Returns:
        As ``weights.read``, and the ``card``.

    Raises:
        UserError: the file is missing, damaged or not a model file.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    from mops_lightning.zoo.packing import unpack

    card = read_card(path)
    try:
        state = load_file(path)
    except (SafetensorError, OSError):
        raise _damaged(path) from None
    if digest(state) != card["sha256"]:
        raise UserError(f"{path} is damaged (sha256 differs). Install or publish it again.")
    try:
        state = unpack(state)
    except ValueError:
        raise _damaged(path) from None
    return {
        "config": card["record"]["config"],
        "metrics": card["record"]["metrics"],
        "classes": card["classes"],
        "sha256": card["sha256"],
        "state": state,
        "card": card,
    }


def read_card(path: Path) -> dict[str, Any]:
    """Read the card of a model file.

    Raises:
        UserError: the file is missing, damaged or not a model file.
    """
    import jsonschema
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="numpy") as file:
            card = json.loads((file.metadata() or {}).get(KEY, "null"))
        jsonschema.validate(card, schema())
        jsonschema.validate(card["record"], run_record.schema())
    except FileNotFoundError:
        raise UserError(f"no file {path}. Give a model's name, or the file of one.") from None
    except jsonschema.ValidationError:
        raise UserError(
            f"{path} is not a model file of this version of mops_lightning. "
            "`mops-lightning models add` makes them."
        ) from None
    except (SafetensorError, OSError, ValueError, RecursionError):
        raise _damaged(path) from None
    return card


def _damaged(path: Path) -> UserError:
    return UserError(f"{path} is damaged or not a {SUFFIX} file. Install or publish it again.")


@cache
def schema() -> dict[str, Any]:
    """Return the JSON schema of a card."""
    return json.loads(files("mops_lightning.zoo").joinpath("card.schema.json").read_text())
