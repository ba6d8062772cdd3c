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


def figure(metric: str, value: float) -> str:
    """Return a value in the unit of its metric, without it."""
    sign = unit(metric)
    if sign == "%":
        return f"{100 * value:.2f}"
    return f"{value:.2f}" if sign else f"{value:.4g}"
