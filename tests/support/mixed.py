"""Mixed precision as a training step sets it."""

import torch

from mops_lightning.ops.precision import restrict_autocast_to_pointwise


def mixed(function, *arguments):
    with torch.autocast("cpu", torch.bfloat16), restrict_autocast_to_pointwise("cpu"):
        return function(*arguments)
