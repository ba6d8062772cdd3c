"""Seeds and generators that do not depend on the global random state."""

import numpy as np
import torch


def derive_seed(*numbers: int) -> int:
    """Hash non-negative numbers to one seed below 2^63."""
    words = np.random.SeedSequence(numbers).generate_state(2, np.uint32)
    low = int(words[0])
    high = int(words[1])
    return (high << 32 | low) >> 1


def generator(*numbers: int) -> torch.Generator:
    """Return a CPU generator seeded with ``derive_seed(*numbers)``."""
    return torch.Generator().manual_seed(derive_seed(*numbers))
