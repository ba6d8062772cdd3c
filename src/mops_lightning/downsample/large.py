"""One file that need not fit in memory: several passes over its chunks."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.downsample.chunks import chunks_of
from mops_lightning.downsample.table import BadCloudError, Column, Table, largest_distance
from mops_lightning.streaming import stream_match, stream_sample


def by_chunks(
    source: Path, sampler: Any, m: int, size: int, readout: str, keep_attributes: bool
) -> tuple[Table, int]:
    """Return what a trained MOPS-Net keeps of a file, and how many points it has.

    Args:
        source: of a format of ``chunks.READERS``.
        sampler: trained.
        m: how many points.
        size: of the chunks; with m it bounds the memory.
        readout: generated or matched.
        keep_attributes: keep the columns of matched points.

    Raises:
        UserError: the file is broken or too small, or the sampler cannot work by chunks.
    """
    number, total = 0, np.zeros(3)
    for part in chunks_of(source, size):
        number += len(part.points)
        total += part.points.sum(0)
    if number < m:
        raise BadCloudError(f"{source} holds {number} points, fewer than --m {m}.")
    centre = total / number
    radius = largest_distance((part.points for part in chunks_of(source, size)), centre, source)

    def chunks() -> Iterator[Tensor]:
        for part in chunks_of(source, size):
            if len(part.points):
                yield torch.from_numpy(((part.points - centre) / radius).astype(np.float32))

    generated = stream_sample(sampler, chunks, m)
    if readout == "generated":
        return Table(generated.double().numpy() * radius + centre), number
    rows = stream_match(generated, chunks).numpy()
    kept = _gathered(source, size, rows)
    return (kept if keep_attributes else kept.bare()), number


def _gathered(source: Path, size: int, rows: NDArray[np.int64]) -> Table:
    """Return the given rows of a file, in their order."""
    start, places, tables = 0, [], []
    for part in chunks_of(source, size):
        inside = np.flatnonzero((rows >= start) & (rows < start + len(part.points)))
        places.append(inside)
        tables.append(part.take(rows[inside] - start))
        start += len(part.points)
    order = np.argsort(np.concatenate(places))

    def joined(columns: list[Column]) -> Column:
        return np.concatenate(columns)[order]

    names = list(tables[0].columns)
    columns = {name: joined([table.columns[name] for table in tables]) for name in names}
    return Table(joined([table.points for table in tables]), columns, tables[0].head)
