"""Losses of all samples, from the functions that compute those of several sizes."""

from mops_lightning.losses.subset import simplification_losses, subset_losses


def subset_loss(points, samples):
    m = samples.shape[1]
    return subset_losses(points, samples, (m,))[m]


def simplification_loss(points, samples, *weights):
    m = samples.shape[1]
    return simplification_losses(points, samples, (m,), *weights)[m]
