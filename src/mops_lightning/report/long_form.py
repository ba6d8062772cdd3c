"""Records as one long table: a row for every test value of every record."""

from collections.abc import Sequence

import pandas as pd

from mops_lightning.records.readout_names import parse_metric_name
from mops_lightning.records.run_record import RunRecord
from mops_lightning.report.collect import epochs, seed, trained_with
from mops_lightning.report.comparable import value
from mops_lightning.report.rows import RowNames, net_labels

NOT_IN_CSV = ("row", "size", "started", "dirty")
"""Further columns: the row of a value, the run's own size, its start, and whether the checkout had
changes."""


def long_form(found: Sequence[RunRecord], rows: RowNames, keys: Sequence[str] = ()) -> pd.DataFrame:
    """Return one row for every test value of every record: the columns of ``table.csv``, and more.

    Args:
        found: completed records.
        rows: the names of their rows.
        keys: settings that get a column, dotted.
    """
    lines = []
    for record, label in zip(found, net_labels(found), strict=True):
        facts = {
            "folder": record.folder,
            "sampler": rows.of(record),
            "learn": trained_with(record),
            "seed": seed(record),
            "epochs": epochs(record) or 0,
            **{key: value(record, key) for key in keys},
            "net": label,
            "commit": record.git["commit"],
            "device": record.device,
            "size": record.config["m"],
            "started": record.started,
            "dirty": bool(record.git["dirty"]),
        }
        for name, figure in record.metrics.items():
            parts = parse_metric_name(name)
            if parts is None or figure is None:
                continue
            m = parts.m
            if m is None:
                m = record.config["m"]
            tested = {
                "m": m,
                "readout": parts.readout,
                "metric": parts.metric,
                "value": figure,
                "row": rows.of_readout(record, parts.readout),
            }
            lines.append({**facts, **tested})
    first = ["folder", "sampler", "learn", "seed", "epochs", "m", "readout", "metric", "value"]
    columns = [*first, *keys, "net", "commit", "device", *NOT_IN_CSV]
    return pd.DataFrame(lines, columns=columns)
