"""The weights format: safetensors, with plain data as JSON in the header.

The header of a run's weights file has the configuration and metrics of the run; the header of a
model has a card. Headers are read without torch and without the tensors.
"""

import hashlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec

from mops_lightning.errors import UserError
from mops_lightning.filesystem import atomic_write
from mops_lightning.records import run_record

if TYPE_CHECKING:
    from torch import Tensor

MODEL = "mops_lightning/model/1"
WEIGHTS = "mops_lightning/weights/2"
SUFFIX = ".safetensors"
KEY = "mops_lightning"
"""Key of the plain data in the header; safetensors writes several keys in random order."""
LONGEST = 1 << 22
"""Most bytes of a header."""

SHA256 = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
NAME_PATTERN = r"^[a-z0-9_-]+(\.[a-z0-9_-]+)+$"
NAME = Annotated[str, msgspec.Meta(pattern=NAME_PATTERN, max_length=100)]
Precision = Literal["float32", "float16", "bfloat16", "int8"]
"""Types of the wide weight matrices of a model."""


class Figures(msgspec.Struct, forbid_unknown_fields=True):
    """Test figures of a model by readout, in the metric's unit.

    Attributes:
        metric: its name.
        m: number of sampled points; None for all points.
        values: the figures.
        points: of a test cloud.
    """

    metric: str
    m: int | None
    values: dict[str, str]
    points: int | None


class RunHeader(msgspec.Struct, forbid_unknown_fields=True, tag_field="schema", tag=WEIGHTS):
    """Plain data in the header of a run's weights file.

    Attributes:
        classes: of a classifier's outputs, in order.
        sha256: of the tensors.
        config: the configuration of the run.
        metrics: its test metrics.
        channels: name, mean and scale of each channel of the points beside x, y and z.
    """

    classes: list[str]
    sha256: SHA256
    config: dict[str, Any]
    metrics: dict[str, Any]
    channels: list[tuple[str, float, float]] = []


class Card(msgspec.Struct, forbid_unknown_fields=True, tag_field="schema", tag=MODEL):
    """Plain data in the header of a model.

    Attributes:
        classes: of a classifier's outputs, in order.
        sha256: of the tensors.
        name: of the model.
        transform: of the input: centroid at the origin, largest distance from it 1.
        licence: of the weights.
        precision: of most weight matrices with 4,096 entries or more; the rest is float32.
        notes: further facts for users.
        figures: its test figures.
        record: of the run that trained the model; ``files.task_weights`` names its task net.
        channels: name, mean and scale of each channel of the points beside x, y and z.
    """

    classes: list[str]
    sha256: SHA256
    name: NAME
    transform: Literal["unit_sphere"]
    licence: str
    precision: Precision
    notes: str
    figures: Figures
    record: dict[str, Any]
    channels: list[tuple[str, float, float]] = []


class Damaged(UserError):
    """A file that this program did not write, or that was changed afterwards."""


def damaged(path: str | Path, reason: str = "") -> Damaged:
    """Return the error for a file that is damaged or of another kind."""
    because = ""
    if reason:
        because = f" ({reason})"
    return Damaged(
        f"{path} is damaged or not a file of this program{because}. Make it again, or give another."
    )


def write(path: Path, header: dict[str, Any], state: "dict[str, Tensor]") -> None:
    """Write tensors with plain data in the header; an existing file is replaced atomically.

    Args:
        path: the file.
        header: see ``RunHeader`` and ``Card``, without ``sha256``, which is added.
        state: tensors by name.

    Raises:
        msgspec.ValidationError: the header does not fit its types: a bug in this program.
        OSError: the file cannot be written.
    """
    from safetensors.torch import save

    header = {**header, "sha256": digest(state)}
    msgspec.convert(header, RunHeader | Card)
    content = save(state, metadata={KEY: json.dumps(header)})
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def read_header(path: Path) -> dict[str, Any]:
    """Read the plain data in the header, checked by its types.

    Raises:
        UserError: the file is missing, or may not be read.
        Damaged: it is damaged or of another kind.
    """
    from safetensors import SafetensorError, safe_open

    if not path.is_file():  # opening a named pipe would wait for its writer
        raise UserError(f"no file {path}. Give a weights file, the folder of its run, or a model.")
    try:
        with path.open("rb") as file:
            if int.from_bytes(file.read(8), "little") > LONGEST:
                raise damaged(path)
        with safe_open(path, framework="numpy") as opened:
            header = json.loads((opened.metadata() or {}).get(KEY, "null"))
        msgspec.convert(header, RunHeader | Card)
        if header.get("channels"):
            from mops_lightning.channels import PointChannels  # imports torch

            PointChannels.from_plain(header["channels"])
        if "record" in header:
            run_record.from_plain(header["record"])
    except PermissionError:
        raise UserError(f"{path} may not be read. Check its permissions.") from None
    except (SafetensorError, OSError, ValueError, RecursionError):
        raise damaged(path) from None
    return header


def read_card(path: Path) -> dict[str, Any]:
    """Read the card of a model; errors as in ``read_header``.

    Raises:
        UserError: it is a run's weights file.
    """
    header = read_header(path)
    if header["schema"] != MODEL:
        raise UserError(
            f"{path} holds the weights of a run and is not a model. `mops-lightning models add` "
            "makes a model of it."
        )
    return header


def digest(state: "dict[str, Tensor]") -> str:
    """Return the sha256 of the names, shapes, types and bytes of tensors, in any order."""
    import torch

    total = hashlib.sha256()
    for name in sorted(state):
        value = state[name].detach().cpu().contiguous()
        described = f"{name} {tuple(value.shape)} {value.dtype}"
        total.update(described.encode())
        as_bytes = value.view(-1).view(torch.uint8)
        total.update(as_bytes.numpy().tobytes())
    return total.hexdigest()
