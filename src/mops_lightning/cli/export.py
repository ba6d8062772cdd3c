"""The subcommand ``export``."""

from pathlib import Path

from mops_lightning.errors import Parser, UserError, one_line_endings

DESCRIPTION = """Write a trained sampler as ONNX (.onnx) or as a PyTorch program (.pt2).

The file maps points (batch, points, 3), float32 in the unit sphere, to generated points
(batch, m, 3), for any number of clouds and points, and runs without mops_lightning. It is compared
with the sampler before it is written."""


def main(arguments: list[str], prog: str) -> None:
    """Write the file and print how far its points are from the sampler's.

    Args:
        arguments: of the command line.
        prog: what the user typed to start this command.
    """
    parser = Parser(prog, DESCRIPTION)
    add = parser.add_argument
    add("sampler", metavar="SAMPLER", help="a model's name, a run or a weights file")
    add("target", metavar="OUT", type=Path, help="a file that ends in .onnx or .pt2")
    add("--m", type=int, help="number of points; default: as the sampler was trained for")
    add("--overwrite", action="store_true", help="replace an existing file")
    with one_line_endings(prog):
        chosen = parser.parse_args(arguments)
        if chosen.target.exists() and not chosen.overwrite:
            raise UserError(f"{chosen.target} exists. Give another OUT, or --overwrite.")
        from mops_lightning.zoo.export import export
        from mops_lightning.zoo.load import load

        difference = export(load(chosen.sampler), chosen.target, chosen.m)
        size = chosen.target.stat().st_size / 1e6
        print(
            f"{chosen.target}: {size:.2f} MB; largest difference from the sampler {difference:.1e}"
        )
