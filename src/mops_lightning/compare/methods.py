"""The methods that are compared."""

from collections.abc import Sequence

from mops_lightning.downsample_files.settings import METHODS, Settings

FILES = ("table.md", "table.csv", "compare.html")
"""What a comparison writes."""
TRAINED = "trained"
FPS = "fps"
"""Always compared: the distance between farthest points is the scale of thin parts."""


def methods(
    m: int,
    names: Sequence[str],
    weights: str | None,
    tile: int | None,
    tile_size: float | None,
    seed: int,
) -> dict[str, Settings]:
    """Return the settings of every method.

    Args:
        m: number of points to keep.
        names: untrained methods.
        weights: of a trained sampler, or None.
        tile: see ``Settings``; for the trained sampler.
        tile_size: likewise.
        seed: of random choices.

    Raises:
        UserError: a value is out of range.
    """
    chosen = [name for name in METHODS if name in names or name == FPS]
    found = {name: Settings(m, method=name, keep_attributes=True, seed=seed) for name in chosen}
    if weights is not None:
        found[TRAINED] = Settings(
            m, weights, keep_attributes=True, seed=seed, tile=tile, tile_size=tile_size
        )
    return found
