"""How metrics are written down for people: in percent, in degrees or as they are."""


def unit(metric: str) -> str:
    """Return the unit in which a metric is shown: ``%``, ``°`` or nothing."""
    if "accuracy" in metric or "recall" in metric:
        return "%"
    return "°" if metric.endswith("_deg") else ""


def title(metric: str) -> str:
    """Return a metric's name in words, with its unit in brackets."""
    sign = f" ({unit(metric)})" if unit(metric) else ""
    return metric.removesuffix("_deg").replace("_", " ") + sign


def scale(metric: str) -> float:
    """Return what a value is multiplied by to be in the unit of its metric."""
    return 100.0 if unit(metric) == "%" else 1.0


def figure(metric: str, value: float) -> str:
    """Return a value in the unit of its metric, without it."""
    value *= scale(metric)
    return f"{value:.2f}" if unit(metric) else f"{value:.4g}"
