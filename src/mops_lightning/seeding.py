"""Random numbers that depend on named numbers only, never on what ran before."""

import numpy as np
import torch


def derive_seed(*numbers: int) -> int:
    """Return one seed (below 2^63) for a tuple of non-negative numbers, well mixed."""
    low, high = np.random.SeedSequence(numbers).generate_state(2, np.uint32)
    return (int(high) << 32 | int(low)) >> 1


def generator(*numbers: int) -> torch.Generator:
    """Return a CPU generator seeded with ``derive_seed(*numbers)``."""
    return torch.Generator().manual_seed(derive_seed(*numbers))
