"""MOPS-Net inside a hierarchical net, on the features that the net has at a stage."""

from torch import Tensor, nn
from torch.nn import functional as F

from mops_lightning.errors import UserError, check_at_least
from mops_lightning.losses.subset import overlap_losses
from mops_lightning.ops.local_matrix import LocalMatrix
from mops_lightning.ops.maxima import max_of_points
from mops_lightning.ops.precision import (
    pointwise_autocast,
    restrict_autocast_to_pointwise,
)
from mops_lightning.ops.sampling_matrix import SamplingMatrix
from mops_lightning.samplers.local import LocalAnchors, Thinned
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.types import SampleOutput

INSIDE_ONLY = (
    "StageMOPSNet samples inside a hierarchical net only, whose features it reads "
    "(sampler@task.net.sampler=mops_stage). Choose sampler=mops outside."
)


class StageMOPSNet(MOPSNet):
    """MOPS-Net with local columns, whose keys are computed from the features of its host.

    A stage of a hierarchical net knows features of its points. This sampler reads them instead of
    computing features of its own from coordinates: one layer of ρ maps the local feature and the
    maximum over the candidates to keys. The points that a column chooses among, those nearest to
    its anchor, are also the neighbourhood whose features the stage gathers, so that one search
    serves both. It works inside such a net only, where it maps ``(B, N, 3)`` points to
    ``(B, m, 3)``.

    Args:
        m: largest number of points; where a cloud has fewer, the host takes as many as it has.
        channels: of the host's features; the host gives their number.
        alpha: weight of the subset loss.
        tau_min: temperature at the end of training and in evaluation.
        key_channels: C, of the keys.
        anchor_width: see ``MOPSNet``.
        overlap: weight of the penalty on columns that choose the same points.
        candidates: see ``MOPSNet``.
        neighbours: see ``MOPSNet``.

    Raises:
        UserError: an argument is out of range, or there is no host.

    Examples:
        >>> import torch
        >>> from mops_lightning import StageMOPSNet
        >>> points, features = torch.rand(2, 64, 3), torch.rand(2, 64, 16)  # (B, N, 3), (B, N, C)
        >>> StageMOPSNet(m=8, channels=16).eval().by_features(points, features, 8).points.shape
        torch.Size([2, 8, 3])
    """

    flexible = True
    nested = True
    queries: LocalAnchors

    def __init__(
        self,
        m: int,
        channels: int | None = None,
        alpha: float = 30.0,
        tau_min: float = 0.1,
        key_channels: int = 16,
        anchor_width: float = 0.5,
        overlap: float = 0.0,
        candidates: int | None = None,
        neighbours: int | None = 16,
    ) -> None:
        if channels is None:
            raise UserError(INSIDE_ONLY)
        check_at_least(1, channels=channels, key_channels=key_channels)
        super().__init__(
            m,
            alpha,
            tau_min,
            feature_channels=[channels],
            rho_channels=[key_channels],
            anchors="fps",
            anchor_width=anchor_width,
            overlap=overlap,
            candidates=candidates,
            neighbours=neighbours,
        )
        # Also where a column chooses among all points: with keys that are given.
        self.queries = LocalAnchors(m, key_channels, anchor_width, candidates, neighbours)
        # The host has features, and their scale is known: its layers end in BatchNorm and ReLU.
        del self.features, self.rho_first
        self.rho_local = nn.Linear(channels, key_channels)

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Refuse points without features."""
        raise UserError(INSIDE_ONLY)

    def sampling_matrix(self, points: Tensor, m: int | None = None) -> SamplingMatrix | LocalMatrix:
        """Refuse points without features."""
        raise UserError(INSIDE_ONLY)

    def by_features(self, points: Tensor, features: Tensor, m: int) -> SampleOutput:
        """Generate m of the points ``(B, N, 3)`` with features ``(B, N, channels)``; no losses."""

        def keys_of(thinned: Thinned) -> Tensor:
            return self._keys_from(thinned.of(features))

        with restrict_autocast_to_pointwise(points.device.type):
            matrix = self.queries.local_matrix(points, keys_of, m, self.tau)
            sampled = matrix.sample(points.to(matrix.dtype))
            sampled = sampled.to(points.dtype)
        neighbours = None
        if not self.is_thinned and self.queries.neighbours is not None:
            neighbours = matrix.rows
        return SampleOutput(sampled, None, {}, matrix, neighbours=neighbours)

    def losses_in_stage(self, output: SampleOutput, squares: Tensor) -> dict[str, Tensor]:
        """Return the weighted losses of points from ``by_features``.

        Args:
            output: m generated points, with their matrix.
            squares: ``(B, m)`` squared distances to the nearest input points.
        """
        losses = {"subset": self.alpha * squares.mean()}
        if self.overlap and output.matrix is not None:
            m = squares.shape[1]
            overlap = overlap_losses(output.matrix, [m])[m]
            losses["overlap"] = self.overlap * overlap
        return losses

    def _keys_from(self, local: Tensor) -> Tensor:
        """Return keys ``(B, K, C)`` of the candidates' features ``(B, K, channels)``."""
        with pointwise_autocast(local.device.type):
            of_cloud = self.rho_global(max_of_points(local))
            hidden = self.rho_local(local).add_(of_cloud[:, None])
            keys = F.relu_(hidden)
        return keys.to(self.queries.weight)
