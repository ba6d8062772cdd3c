"""Types that data, samplers, tasks and metrics exchange, and the letters of their shapes.

``B`` clouds in a batch, ``N`` input points, ``M`` sampled points, ``C`` channels, ``S`` shapes in
a split. Points are float32 ``(B, N, 3 + C)``: x, y and z in the unit sphere, without unit, then
channels, most often none (see ``channels``).
"""

from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

from torch import Tensor

if TYPE_CHECKING:
    from mops_lightning.ops.local_matrix import LocalMatrix
    from mops_lightning.ops.sampling_matrix import SamplingMatrix

UNKNOWN = -1
"""The part number of a point whose part is not known."""


class Batch(NamedTuple):
    """One batch of clouds.

    Attributes:
        points: ``(B, N, 3 + C)``.
        labels: ``(B,)`` int64 class numbers.
        rows: ``(B,)`` int64 rows of the clouds in their split, or None.
        parts: ``(B, N)`` int64 part numbers of the points, or ``UNKNOWN``; or None.
    """

    points: Tensor
    labels: Tensor
    rows: Tensor | None = None
    parts: Tensor | None = None

    @property
    def num_clouds(self) -> int:
        """Number of clouds, B."""
        return len(self.points)


class PairBatch(NamedTuple):
    """One batch of pairs for registration.

    Attributes:
        points: ``(2B, N, 3 + C)`` all sources, then all targets, each with its centroid at the
            origin; one tensor, so that a sampler processes all clouds in one pass.
        centroids: ``(2B, 3)`` the subtracted centroids.
        quaternion: ``(B, 4)`` rotation of the true motion from source to target, scalar first.
        translation: ``(B, 3)`` its translation. Both refer to the clouds before centring.
    """

    points: Tensor
    centroids: Tensor
    quaternion: Tensor
    translation: Tensor

    @property
    def num_clouds(self) -> int:
        """Number of pairs, B."""
        return len(self.quaternion)


class SampleOutput(NamedTuple):
    """The output of every sampler; a NamedTuple, which device transfer and collation support.

    Attributes:
        points: ``(B, M, 3 + C)`` the sampled points.
        indices: ``(B, M)`` int64 rows of the input, or None when the points are generated.
        losses: the sampler's own weighted loss terms, to add to the task loss.
        matrix: the sampling matrix S that generated the points, or None.
        soft_projected: ``(B, M, 3 + C)`` points on which the task net is trained in place of
            ``points``, or None; only in training. See ``Sampler.project`` for the readout.
        log_residuals: ``(B, N)`` logarithms of the residuals that the sampler expects at the input
            points in registration, or None.
        neighbours: ``(B, M, k)`` int64 rows of the input points around every sampled point,
            nearest first, or None where the sampler has not searched for them.

    Examples:
        >>> import torch
        >>> from mops_lightning import SampleOutput
        >>> points = torch.rand(2, 8, 3)
        >>> SampleOutput(points, torch.arange(8).expand(2, 8), {}).first(5).points.shape
        torch.Size([2, 5, 3])
    """

    points: Tensor
    indices: Tensor | None
    losses: dict[str, Tensor]
    matrix: "SamplingMatrix | LocalMatrix | None" = None
    soft_projected: Tensor | None = None
    log_residuals: Tensor | None = None
    neighbours: Tensor | None = None

    def first(self, m: int) -> "SampleOutput":
        """Return the first ``m`` points, without the losses, which cover all points."""
        if m == self.points.shape[1]:
            return self._replace(losses={})
        return SampleOutput(
            self.points[:, :m],
            None if self.indices is None else self.indices[:, :m],
            {},
            None if self.matrix is None else self.matrix.leftmost(m),
            None if self.soft_projected is None else self.soft_projected[:, :m],
            self.log_residuals,
            None if self.neighbours is None else self.neighbours[:, :m],
        )


class TaskOutput(NamedTuple):
    """The output of a task's step.

    Attributes:
        losses: the task's weighted loss terms.
        predictions: first argument of the task's metrics.
        targets: second argument of the task's metrics.
        output: what the task net returned; see ``Task.predict``.
    """

    losses: dict[str, Tensor]
    predictions: Any
    targets: Any
    output: Any = None


@runtime_checkable
class PointFeatureNet(Protocol):
    """A task net whose result depends on a cloud through maxima over points only.

    The features of a point must not depend on other points of the cloud. Then the maxima of a
    sample follow from the features of the whole cloud, without running the net on the sample.
    """

    def point_features(self, points: Tensor) -> Tensor:
        """Map ``(B, N, 3 + C)`` points to non-negative features ``(B, N, C)``."""
