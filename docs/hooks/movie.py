"""The moving picture of the README: a cloud, 32 points of it, the prediction from these, and back.

    python docs/hooks/movie.py docs/assets/mops.gif

The sampler, the classifier and the names of the classes are those of shipped models and their
records; the cloud is one of the test clouds that the tests of the models use.
"""

import argparse
import io
from pathlib import Path

import numpy as np
import torch
from matplotlib import colormaps
from numpy.typing import NDArray
from PIL import Image

from mops_lightning import load, propagation_map
from mops_lightning.viz.figures import cloud_axes, frame_cloud, new_figure, upright
from mops_lightning.zoo import model_file, names
from mops_lightning.zoo.load import load_net

SAMPLER, CLASSIFIER = "mops.modelnet40-m32", "pointnet.modelnet40"
CLOUDS = Path(__file__).parents[2] / "tests" / "zoo" / "clouds.npz"
GREY = 0.55
STILL, MOVING = 5, 8
"""Frames that show one state, and frames between two states."""
SECONDS = 0.12
COLOURS = 32


def read_cloud(number: int) -> NDArray[np.float32]:
    """Return one of the committed test clouds ``(N, 3)``; see ``tests/zoo/test_models.py``."""
    with np.load(CLOUDS) as content:
        halves = np.ascontiguousarray(np.moveaxis(content["clouds"], 0, 3)).view(np.float16)
    return np.moveaxis(halves[..., 0], 0, 2)[number].astype(np.float32)


@torch.no_grad()
def sample_and_classify(cloud: NDArray[np.float32]) -> tuple[NDArray[np.float32], str]:
    """Return the generated points ``(m, 3)``, and the class that the classifier predicts."""
    card = model_file.read_card(names.available()[CLASSIFIER])
    classes = card["record"]["class_names"]
    sampled = load(SAMPLER)(torch.from_numpy(cloud)[None]).points
    share = load_net(CLASSIFIER)(sampled).softmax(1)[0]
    return sampled[0].numpy(), f"{classes[int(share.argmax())]}, {float(share.max()):.0%}"


def draw(
    cloud: NDArray[np.float32],
    sampled: NDArray[np.float32],
    prediction: str,
    still: int = STILL,
    moving: int = MOVING,
) -> list[Image.Image]:
    """Return the frames.

    Every point of the cloud moves to its nearest sampled point and back, where it has the colour of
    that point: what ``mops_lightning.propagate`` does with labels.
    """
    nearest = propagation_map(cloud, sampled, 1).rows[:, 0].numpy()
    order = sampled @ np.array([0.3, 1.0, 0.2])  # neighbours in this order have similar colours
    tints = colormaps["turbo"](order.argsort().argsort() / max(len(sampled) - 1, 1))[:, :3]
    ends = [np.full((len(cloud), 3), GREY), tints[nearest]]
    steps = (1 - np.cos(np.linspace(0, np.pi, moving + 2)[1:-1])) / 2
    states = [(0.0, 0, f"{len(cloud):,} points")] * still
    states += [(step, 0, f"{len(cloud):,} points") for step in steps]
    states += [(1.0, 1, f"{len(sampled)} points by MOPS-Net")] * still
    states += [(1.0, 1, f"PointNet: {prediction}")] * (2 * still)
    states += [(1 - step, 1, f"back to {len(cloud):,} points") for step in steps]
    states += [(0.0, 1, f"back to {len(cloud):,} points")] * (2 * still)
    frames = []
    for place, (step, coloured, title) in enumerate(states):
        figure = new_figure(3.2, 3.4)
        axes = cloud_axes(figure, 1, 1, 0, 0, title)
        points = upright(cloud + step * (sampled[nearest] - cloud))
        axes.scatter(*points.T, c=ends[coloured], s=2.5 + 25 * step**4, depthshade=False)
        frame_cloud(axes, upright(cloud))
        axes.view_init(elev=18, azim=-60 + 360 * place / len(states))
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=100)
        frames.append(Image.open(buffer).convert("RGB"))
    return frames


def write(frames: list[Image.Image], path: Path) -> None:
    """Write frames as a GIF with one palette."""
    palette = Image.new("RGB", (frames[0].width, frames[0].height * 2))
    for place, frame in enumerate((frames[0], frames[-1])):
        palette.paste(frame, (0, place * frame.height))
    colours = palette.quantize(COLOURS)
    small = [frame.quantize(palette=colours, dither=Image.Dither.NONE) for frame in frames]
    duration = int(1000 * SECONDS)
    small[0].save(path, save_all=True, append_images=small[1:], duration=duration, loop=0)


def main() -> None:
    """Write the moving picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("target", type=Path, help="a .gif file")
    parser.add_argument("--cloud", type=int, default=0, help="number of the test cloud")
    chosen = parser.parse_args()
    cloud = read_cloud(chosen.cloud)
    write(draw(cloud, *sample_and_classify(cloud)), chosen.target)


if __name__ == "__main__":
    main()
