"""What flows between data, sampler, task and metrics, and the letters of its shapes.

``B`` clouds in a batch, ``N`` input points, ``M`` sampled points, ``C`` channels, ``S`` shapes in
a split. Points are float32 ``(B, N, 3)``, coordinates without unit in the unit sphere.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

from torch import Tensor

if TYPE_CHECKING:
    from mops_lightning.ops.sampling_matrix import SamplingMatrix


class Batch(NamedTuple):
    """One batch of clouds.

    Attributes:
        points: ``(B, N, 3)``.
        labels: ``(B,)`` int64 class numbers.
    """

    points: Tensor
    labels: Tensor


class PairBatch(NamedTuple):
    """One batch of pairs for registration.

    Attributes:
        points: ``(2B, N, 3)`` the sources, then the targets, each with its centroid at the origin;
            one tensor, so that a sampler sees all clouds in one pass.
        centroids: ``(2B, 3)`` what was subtracted.
        quaternion: ``(B, 4)`` rotation of the true motion from source to target, scalar first,
        translation: ``(B, 3)`` and its translation; both are of the clouds before centring.
    """

    points: Tensor
    centroids: Tensor
    quaternion: Tensor
    translation: Tensor


class SampleOutput(NamedTuple):
    """What every sampler returns; a NamedTuple, so it survives device transfer and collation.

    Attributes:
        points: ``(B, M, 3)`` the sampled points.
        indices: ``(B, M)`` int64 rows of the input, or None when the points are generated.
        losses: the sampler's own loss terms, already weighted, to be added to the task loss.
        matrix: the sampling matrix S behind the points, or None.
        soft_projected: ``(B, M, 3)`` what the task net is trained on in place of ``points``, or
            None; exists in training only and is never a test result.

    Example:
        >>> import torch
        >>> from mops_lightning import SampleOutput
        >>> points = torch.rand(2, 8, 3)
        >>> SampleOutput(points, torch.arange(8).expand(2, 8), {}).first(5).points.shape
        torch.Size([2, 5, 3])
    """

    points: Tensor
    indices: Tensor | None
    losses: dict[str, Tensor]
    matrix: "SamplingMatrix | None" = None
    soft_projected: Tensor | None = None

    def first(self, m: int) -> "SampleOutput":
        """Return the output of the first ``m`` points; losses, being of all of them, stay out."""
        if m == self.points.shape[1]:
            return self._replace(losses={})
        return SampleOutput(
            self.points[:, :m],
            None if self.indices is None else self.indices[:, :m],
            {},
            None if self.matrix is None else self.matrix.leftmost(m),
            None if self.soft_projected is None else self.soft_projected[:, :m],
        )


class TaskOutput(NamedTuple):
    """What a task's step returns.

    Attributes:
        losses: the task's loss terms, already weighted.
        predictions: what the task's metrics compare,
        targets: and what they compare it with.
    """

    losses: dict[str, Tensor]
    predictions: Any
    targets: Any
