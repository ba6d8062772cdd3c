"""Losses that are no part of a task: pure functions."""

from torch import Tensor

from mops_lightning.geometry import nearest


def subset_loss(points: Tensor, samples: Tensor) -> Tensor:
    """Measure how far generated points are from being a subset of the cloud.

    L_subset(P, Q) = 1/m Σ_j min_i ‖q_j − p_i‖², paper section "Joint Training Loss"; here its mean
    over the clouds.

    Args:
        points: ``(B, N, 3)`` the clouds P.
        samples: ``(B, M, 3)`` the generated points Q.

    Returns:
        A scalar in squared units of the coordinates; 0 where every sample is an input point.
    """
    return nearest(samples, points)[0].mean()


def simplification_loss(
    points: Tensor, samples: Tensor, coverage: float = 1.0, coverage_per_point: float = 0.0
) -> Tensor:
    """Measure how far generated points are from the cloud, and the cloud from them.

    L_simplify(Q, P) = mean_q d²(q, P) + max_q d²(q, P) + (γ + δ·M)·mean_p d²(p, Q), with d² the
    squared distance to the nearest point of the other set; its mean over the clouds. S-Net (Dovrat
    et al., CVPR 2019, section "Loss") and SampleNet (Lang et al., CVPR 2020) train with it.

    Args:
        points: ``(B, N, 3)`` the clouds P.
        samples: ``(B, M, 3)`` the generated points Q.
        coverage: γ.
        coverage_per_point: δ.

    Returns:
        A scalar in squared units of the coordinates.
    """
    to_cloud = nearest(samples, points)[0]
    from_cloud = nearest(points, samples)[0]
    weight = coverage + coverage_per_point * samples.shape[1]
    return (to_cloud.mean(1) + to_cloud.amax(1) + weight * from_cloud.mean(1)).mean()
