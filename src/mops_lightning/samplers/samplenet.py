"""SampleNet, a baseline in the paper's tables: S-Net with a soft projection onto the cloud."""

from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor, nn

from mops_lightning.channels import coordinates
from mops_lightning.errors import UserError, check_at_least, did_you_mean
from mops_lightning.ops.nearest import k_nearest
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.snet import SNet
from mops_lightning.types import SampleOutput


def soft_projection(queries: Tensor, points: Tensor, k: int, sigma: Tensor | float) -> Tensor:
    """Replace every query by a weighted mean of its k nearest points.

    The result is Σ_i w_i·p_i with w = softmax(−d²(q, p_i)/σ) over the k nearest points (SampleNet,
    section "Soft projection"). For σ → 0 it is the nearest point.

    Args:
        queries: ``(B, M, 3)``, or with channels, which do not count.
        points: ``(B, N, 3 + C)``, N ≥ k; distances are between coordinates.
        k: number of neighbours.
        sigma: σ > 0, in squared units of the coordinates.

    Returns:
        ``(B, M, 3 + C)``; gradients flow to queries, points and σ.

    Raises:
        UserError: k is out of range.
    """
    distances, indices = k_nearest(coordinates(queries), coordinates(points), k)
    # Softmax is shift-invariant; the shift keeps the nearest logit finite for tiny σ.
    weights = ((distances[..., :1] - distances) / sigma).softmax(2)
    return (weights[..., None] * gather_points(points, indices)).sum(2)


class SampleNet(SNet):
    """S-Net with a soft projection of its points onto the cloud.

    Lang, Manor and Avidan, "SampleNet: Differentiable Point Cloud Sampling", CVPR 2020.

    In training, the task net receives the projected points. In evaluation they are a readout,
    ``projected``, beside the generated points (the publication's simplified points), which are
    S-Net's, and the matched and completed points.

    Args:
        m: number of points to generate.
        k: number of neighbours of the projection.
        beta: weight of the projection loss σ (β in the MOPS-Net paper).
        gamma: weight of the simplification loss (γ in the MOPS-Net paper); None means ``alpha``,
            its name in SampleNet's publication.
        sigma_min: lower bound of σ = t², where t is learned and starts at 1.
        **settings: arguments of ``SNet``; ``alpha`` is the weight of the simplification loss.

    Raises:
        UserError: an argument is out of range.

    Examples:
        >>> import torch
        >>> from mops_lightning import SampleNet
        >>> output = SampleNet(m=8)(torch.rand(2, 64, 3))  # (B, N, 3), in training mode
        >>> output.points.shape, output.soft_projected.shape  # (B, m, 3)
        (torch.Size([2, 8, 3]), torch.Size([2, 8, 3]))
    """

    projects = True

    def __init__(
        self,
        m: int,
        k: int = 7,
        beta: float = 1.0,
        gamma: float | None = None,
        sigma_min: float = 0.0,
        **settings: Any,
    ) -> None:
        super().__init__(m, **settings)
        check_at_least(0, beta=beta, gamma=gamma or 0, sigma_min=sigma_min)
        check_at_least(1, k=k)
        self.k = k
        self.beta = beta
        self.alpha = self.alpha if gamma is None else gamma
        self.sigma_min = sigma_min
        self.temperature = nn.Parameter(torch.ones(()))

    @property
    def sigma(self) -> Tensor:
        """The temperature σ = t² of the projection, at least ``sigma_min``."""
        return self.temperature.square().clamp(min=self.sigma_min)

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Generate points, in training together with their soft projection.

        Raises:
            UserError: there are fewer than k points in training.
        """
        output = super().sample(points, m)
        if not self.training:
            return output
        return output._replace(soft_projected=self.project(output.points, points))

    def project(self, generated: Tensor, points: Tensor) -> Tensor:
        """Return the soft projection of generated points; see ``Sampler.project``.

        Raises:
            UserError: there are fewer than k points.
        """
        projected = soft_projection(generated, points, self.k, self.sigma)
        return self.point_channels.renormalised(projected)

    def losses(
        self, points: Tensor, output: SampleOutput, sizes: Sequence[int]
    ) -> dict[int, dict[str, Tensor]]:
        """Return the weighted simplification loss at every size, and β·σ once over all sizes."""
        losses = super().losses(points, output, sizes)
        # The publication adds β·σ once per step. Every size has the share that makes the sum or
        # the mean over the sizes β·σ.
        share = 1.0 if self.size_reduction == "mean" else 1 / len(losses)
        projection = {"projection": share * self.beta * self.sigma}
        return {m: {**terms, **projection} for m, terms in losses.items()}


class ProgressiveSampleNet(SampleNet):
    """SampleNet with nested samples: the first m points are the sample of size m.

    SampleNetProgressive of Lang, Manor and Avidan, "SampleNet", CVPR 2020, after ProgressiveNet of
    Dovrat, Lang and Avidan, "Learning to Sample", CVPR 2019.

    Args:
        m_max: largest number of points; 1,024 in the publication.
        min_size: smallest training size, or m_max if that is smaller; training sizes are m_max and
            the doubles of min_size. In the publication 2 for classification, 16 for reconstruction.
        size_reduction: ``sum`` (classification) or ``mean`` (reconstruction) of the losses at all
            sizes.
        **settings: arguments of ``SampleNet``.

    Raises:
        UserError: an argument is out of range.

    Examples:
        >>> import torch
        >>> from mops_lightning import ProgressiveSampleNet
        >>> sampler = ProgressiveSampleNet(m_max=32).eval()
        >>> sampler(torch.rand(2, 64, 3), m=5).points.shape  # (B, N, 3) to (B, m, 3)
        torch.Size([2, 5, 3])
        >>> sampler.training_sizes()
        (2, 4, 8, 16, 32)
    """

    flexible = True
    nested = True

    def __init__(
        self,
        m_max: int = 1024,
        min_size: int = 2,
        size_reduction: Literal["sum", "mean"] = "sum",
        **settings: Any,
    ) -> None:
        super().__init__(m_max, **settings)
        check_at_least(1, min_size=min_size)
        if size_reduction not in ("sum", "mean"):
            hint = did_you_mean(size_reduction, ("sum", "mean"))
            raise UserError(f"size_reduction: unknown {size_reduction!r}.{hint}")
        self.min_size = min_size
        self.size_reduction = size_reduction

    def training_sizes(self) -> tuple[int, ...]:
        """Return ``min_size``, its doubles below the largest size, and the largest size."""
        sizes = {self.m}
        size = self.min_size
        while size < self.m:
            sizes.add(size)
            size *= 2
        return tuple(sorted(sizes))
