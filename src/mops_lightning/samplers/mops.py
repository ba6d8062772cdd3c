"""MOPS-Net, the learned sampler of the paper."""

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from mops_lightning.channels import PointChannels, coordinates
from mops_lightning.errors import UserError, check_at_least
from mops_lightning.losses.subset import overlap_losses, subset_losses
from mops_lightning.nets.layers import PointFeatures, PointMLP, check_channels, linear_norm_relu
from mops_lightning.ops.local_matrix import LocalMatrix
from mops_lightning.ops.precision import pointwise_autocast, pointwise_autocast_dtype
from mops_lightning.ops.sampling_matrix import SamplingMatrix
from mops_lightning.samplers.anchors import FPSAnchors
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.fused import FusedMOPSNet, fused_layer, fused_layers
from mops_lightning.samplers.local import LocalAnchors, Thinned
from mops_lightning.samplers.own_frame import in_own_frame
from mops_lightning.types import SampleOutput

DEFAULT_WIDTH = 0.5
MAX_WIDTH = 100
"""Limit of ``anchor_width``. Columns are uniform long before; far above it, squares overflow."""


class MOPSNet(Sampler):
    """MOPS-Net (paper sections "Feature Extraction" to "Joint Training Loss").

    The local feature of every point is concatenated with the global feature of the cloud and passed
    through the MLP ρ with m outputs. Their softmax over the points, with temperature tau, gives the
    columns of the sampling matrix S (Eq. 5). The sampled points are SᵀP (Eq. 6).

    Args:
        m: number of points to generate.
        alpha: weight α of the subset loss (Eq. 11).
        tau_min: temperature at the end of training and in evaluation; training starts at 1.
        feature_channels: sizes of the pointwise layers; the last is the size of the local and the
            global feature.
        rho_channels: sizes of the hidden layers of ρ.
        threshold: in evaluation, entries of S below it count as zero, as ``SamplingMatrix.sparse``
            drops them (paper section "Efficient Regression of the Sampled Set", with 0.01); 0 keeps
            all. Sampling in chunks keeps all.
        anchors: ``fps`` lets the columns of S start as a soft choice of the cloud's farthest points
            (see ``anchors``); ``framed`` also computes the features from coordinates in a frame
            that turns with the cloud (see ``own_frame``), so that S is the same for a cloud and its
            turned copy; None, as in the paper, lets the columns start at random.
        anchor_width: how soft that choice is before training: the width of the columns as a share
            of the spacing of the farthest points. Only with anchors.
        candidates: c, columns choose among the first c·m farthest points of the cloud, whose
            features alone are computed (see ``local``); None, as in the paper, for all points.
            Only with anchors.
        neighbours: k, every column chooses among its k nearest candidates; None, as in the paper,
            for all. Only with anchors.
        overlap: weight of the penalty on columns of S that choose the same points
            (``losses.subset``); 0, as in the paper, for none.
        point_channels: channels of the points, or their number. Generated points have SᵀF, with
            normals of length 1.

    Raises:
        UserError: an argument is out of range.

    Examples:
        >>> import torch
        >>> from mops_lightning import MOPSNet
        >>> points = torch.rand(2, 64, 3)  # (B, N, 3)
        >>> output = MOPSNet(m=8).eval()(points)
        >>> output.points.shape  # (B, m, 3)
        torch.Size([2, 8, 3])
        >>> output.matrix.dense().shape  # (B, N, m)
        torch.Size([2, 64, 8])
    """

    generates = True

    def __init__(
        self,
        m: int,
        alpha: float = 30.0,
        tau_min: float = 0.1,
        feature_channels: Sequence[int] = (64, 64, 64, 128, 128),
        rho_channels: Sequence[int] = (512, 256, 128),
        threshold: float = 0.0,
        anchors: Literal["fps", "framed"] | None = None,
        anchor_width: float = DEFAULT_WIDTH,
        overlap: float = 0.0,
        candidates: int | None = None,
        neighbours: int | None = None,
        point_channels: PointChannels | int = 0,
    ) -> None:
        super().__init__(m)
        self.point_channels = PointChannels.of(point_channels)
        if not 0 < tau_min <= 1:
            raise UserError(f"tau_min must be above 0 and at most 1, got {tau_min}.")
        check_at_least(0, alpha=alpha, overlap=overlap)
        check_channels("feature_channels", feature_channels)
        check_channels("rho_channels", rho_channels)
        if anchors not in (None, "fps", "framed"):
            raise UserError(f"anchors must be fps, framed or null, got {anchors!r}.")
        check_width(anchors, anchor_width)
        check_local(anchors, candidates=candidates, neighbours=neighbours)
        if not 0 <= threshold < 1:
            raise UserError(f"threshold must be at least 0 and below 1, got {threshold}.")
        self.alpha = alpha
        self.overlap = overlap
        self.threshold = threshold
        self.tau_min = tau_min
        self.training_tau = 1.0
        self.is_framed = anchors == "framed"
        self.streams = anchors is None  # farthest points need all points at once
        self.is_thinned = candidates is not None
        local = feature_channels[-1]
        input_channels = 3 + len(self.point_channels)
        self.features = PointFeatures(PointMLP([input_channels, *feature_channels]))
        # The first layer of ρ acts on [local, global]. The product with the global feature is the
        # same for all points of a cloud, so it is computed once per cloud.
        self.rho_local = nn.Linear(local, rho_channels[0], bias=False)
        self.rho_global = nn.Linear(local, rho_channels[0], bias=False)
        norm = nn.BatchNorm1d(rho_channels[0])
        self.rho_first = nn.Sequential(norm, nn.ReLU(inplace=True))
        self.rho = linear_norm_relu(rho_channels)
        width = rho_channels[-1]
        self.queries: nn.Linear | FPSAnchors
        if anchors is None:
            # A bias would be constant within a column of S, where the softmax cancels it.
            self.queries = nn.Linear(width, m, bias=False)
        elif candidates is None and neighbours is None:
            self.queries = FPSAnchors(m, width, anchor_width)
        else:
            self.queries = LocalAnchors(m, width, anchor_width, candidates, neighbours)

    @property
    def tau(self) -> float:
        """The current temperature: annealed in training, ``tau_min`` in evaluation."""
        if self.training:
            return self.training_tau
        return self.tau_min

    def anneal(self, progress: float) -> None:
        """Set tau, exponentially from 1 to ``tau_min`` for a progress from 0 to 1."""
        share = min(max(progress, 0.0), 1.0)
        self.training_tau = self.tau_min**share

    def sampling_matrix(self, points: Tensor, m: int | None = None) -> SamplingMatrix | LocalMatrix:
        """Return the sampling matrices S of ``(B, N, 3 + C)`` points, with the first m columns."""
        if m is None:
            m = self.m
        places = coordinates(points)
        described = points
        if self.is_framed:
            described = in_own_frame(points, self.point_channels)
        if isinstance(self.queries, LocalAnchors):

            def keys_of(thinned: Thinned) -> Tensor:
                return self._keys(thinned.of(described))

            return self.queries.local_matrix(places, keys_of, m, self.tau)
        keys = self._keys(described)
        if isinstance(self.queries, FPSAnchors):
            return self.queries(places, keys, m, self.tau)
        return SamplingMatrix(self.queries.weight, keys, self.tau).leftmost(m)

    def _keys(self, points: Tensor) -> Tensor:
        """Return the inputs of the last layer of ρ ``(B, N, C)``."""
        plain = self.training or torch.is_grad_enabled()
        plain |= torch.compiler.is_compiling()  # a graph has the weights as they are
        if not plain and pointwise_autocast_dtype() is None:
            return self._fused_keys(points)
        local, global_ = self.features(points)
        with pointwise_autocast(points.device.type):
            from_global = self.rho_global(global_)[:, None]
            hidden = self.rho_local(local).add_(from_global)
            rows = self.rho(self.rho_first(hidden.flatten(0, 1)))
        keys = rows.to(self.queries.weight)
        return keys.unflatten(0, points.shape[:2])

    def fused(self) -> FusedMOPSNet:
        """Return the network for inference with BatchNorm fused, with copies of the weights.

        Raises:
            UserError: the sampler has anchors, which a part of a cloud does not determine.
        """
        if not self.streams:
            return super().fused()
        return self._fused()

    def _fused(self) -> FusedMOPSNet:
        norm = self.rho_first[0]
        assert isinstance(norm, nn.BatchNorm1d)
        queries = self.queries.weight.detach() / self.tau_min
        return FusedMOPSNet(
            fused_layers(self.features.mlp.layers),
            # The shift of BatchNorm applies to the sum once, so only one of the parts gets it.
            fused_layer(self.rho_local, norm),
            fused_layer(self.rho_global, norm).weight,
            fused_layers(self.rho),
            queries,
        )

    def _fused_keys(self, points: Tensor) -> Tensor:
        """Return the keys without gradients, from the fused network."""
        net = self._fused()
        rows = net.local_features(points.flatten(0, 1))
        local = rows.unflatten(0, points.shape[:2])
        peaks = local.amax(1)
        clouds, number, _ = local.shape
        keys = local.new_empty(clouds, number, net.queries.shape[1])
        for cloud, peak, into in zip(local, peaks, keys, strict=True):
            net.keys(cloud, peak, into)
        return keys

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Generate points; see ``Sampler.forward``."""
        matrix = self.sampling_matrix(points, m)
        # With anchors, S is at least float32, also where points and weights are half.
        values = points.to(matrix.dtype)
        if self.threshold and not self.training:
            sampled = torch.bmm(matrix.sparse(self.threshold).mT, values)
        else:
            sampled = matrix.sample(values)
        sampled = self.point_channels.renormalised(sampled.to(points.dtype))
        return SampleOutput(sampled, None, {}, matrix)

    def losses(
        self, points: Tensor, output: SampleOutput, sizes: Sequence[int]
    ) -> dict[int, dict[str, Tensor]]:
        """Return α times the subset loss at every size (section "Joint Training Loss", Eq. 11).

        With ``overlap``, also the penalty on columns that choose the same points.
        """
        subset = subset_losses(points, output.points, sizes)
        losses = {}
        for m, loss in subset.items():
            losses[m] = {"subset": self.alpha * loss}
        if self.overlap and output.matrix is not None:
            for m, loss in overlap_losses(output.matrix, sizes).items():
                losses[m]["overlap"] = self.overlap * loss
        return losses


def check_width(anchors: str | None, anchor_width: float) -> None:
    """Check the width of anchors, which has no effect without them."""
    if not 0 < anchor_width <= MAX_WIDTH:
        raise UserError(
            f"anchor_width must be above 0 and at most {MAX_WIDTH}, got {anchor_width}."
        )
    if anchors is None and anchor_width != DEFAULT_WIDTH:
        raise UserError(
            f"anchor_width has no effect without anchors=fps, got {anchor_width}. Add "
            f"anchors=fps, or set anchor_width={DEFAULT_WIDTH}."
        )


def check_local(anchors: str | None, **settings: int | None) -> None:
    """Check the numbers of local columns.

    Raises:
        UserError: a number is not a whole one of at least 1, or there are no anchors.
    """
    for name, value in settings.items():
        if value is None:
            continue
        if anchors is None:
            raise UserError(f"{name} needs anchors=fps, got {name}={value!r}.")
        is_whole = isinstance(value, int) and not isinstance(value, bool)
        if not is_whole or value < 1:
            raise UserError(f"{name} must be a whole number of at least 1 or null, got {value!r}.")
