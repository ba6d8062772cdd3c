"""What a figure shows."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def drawn_places(collection: Any) -> NDArray[np.float64]:
    """Return the points ``(N, 3)`` of a collection of 3-D axes, in matplotlib's coordinates."""
    return np.array(collection._offsets3d).T
