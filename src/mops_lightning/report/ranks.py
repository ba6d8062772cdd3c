"""The best and the second values of a table."""

import numpy as np
import pandas as pd

from mops_lightning.metrics.info import MetricInfo
from mops_lightning.records.readout_names import COMPLETED, GENERATED, INDEX_READOUT, PROJECTED

LEVEL = 2
"""Standard deviations within which a value is level with the best."""


def ranked(table: pd.DataFrame, metric: MetricInfo) -> pd.DataFrame:
    """Add the rank of each value among the rows of its column, and whether it is level.

    Points chosen from the input compete with completed sets, projected points with generated
    ones. Equal texts have equal ranks. A value is level with the best, and has its rank, if it is
    less than two standard deviations away, the larger of the two deviations over seeds, or if it is
    better than such a value: a large deviation alone puts no value before a better one.

    Args:
        table: a row for every cell and readout: ``row``, ``m``, ``column``, ``down``, ``readout``,
            ``mean``, ``std``.
        metric: says how values are shown, and which are better.
    """
    table["rank"] = 0
    table["level"] = False
    if metric.higher_is_better is None:
        return table
    best_of = "min"
    if metric.higher_is_better:
        best_of = "max"
    readouts = table["readout"].replace({INDEX_READOUT: COMPLETED, PROJECTED: GENERATED})
    competition = [readouts, table["m"], table["column"], table["down"]]
    shown = pd.to_numeric(table["mean"].map(metric.format))
    best = shown.groupby(competition).transform(best_of)
    is_best = shown == best
    deviation = metric.scale * table["std"].fillna(0.0)
    deviations_of_best = deviation.where(is_best)
    deviation_of_best = deviations_of_best.groupby(competition).transform("max")
    reach = LEVEL * np.maximum(deviation, deviation_of_best)
    away = (shown - best).abs()
    within_reach = away.where(is_best | (away < reach))
    is_near = away <= within_reach.groupby(competition).transform("max")
    others = shown.where(~is_near)
    second = others.groupby(competition).transform(best_of)
    has_rivals = shown.groupby(competition).transform("count") > 1
    table["level"] = has_rivals & is_near & ~is_best
    table.loc[has_rivals & (shown == second), "rank"] = 2
    table.loc[has_rivals & is_near, "rank"] = 1
    return table
