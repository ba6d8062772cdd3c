"""Greedy selection of the points that cover the task net's max-pooled features."""

from typing import Literal

import torch
from torch import Tensor, nn

from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.ops.facility_location import facility_location
from mops_lightning.samplers.task_net import TaskNetSampler
from mops_lightning.types import PooledNet

WEIGHTINGS = ("none", "gradient")


class SubmodularSampler(TaskNetSampler):
    """Choose points whose max-pooled features are nearly those of the full cloud, without training.

    With f_ic the feature c of point i, points are chosen greedily so that Σ_c w_c max_i f_ic over
    the chosen points grows most (facility location, see ``ops.facility_location``). Once the
    maxima are those of the full cloud, farthest points follow. Flexible and nested.

    Args:
        m: largest number of points to return.
        net: the task net, see ``TaskNetSampler``.
        weighting: ``none`` (w = 1), or ``gradient``: w_c = |∂ log p / ∂ max_i f_ic| at the full
            cloud, where p is the probability of the class that the net predicts; for classifiers.
        seed: breaks ties.

    Raises:
        UserError: ``net`` is missing or unsuitable, or ``weighting`` is unknown.

    Examples:
        >>> import torch
        >>> from mops_lightning import SubmodularSampler
        >>> from mops_lightning.nets.pointnet import PointNetVanilla
        >>> net = PointNetVanilla(num_classes=40)
        >>> SubmodularSampler(m=8, net=net)(torch.rand(2, 64, 3)).indices.shape  # (B, m)
        torch.Size([2, 8])
    """

    def __init__(
        self,
        m: int,
        net: nn.Module | None = None,
        weighting: Literal["none", "gradient"] = "none",
        seed: int = 0,
    ) -> None:
        super().__init__(m, net, seed)
        if weighting not in WEIGHTINGS:
            raise UserError(
                f"weighting: unknown {weighting!r}.{did_you_mean(weighting, WEIGHTINGS)}"
            )
        self.weighting = weighting

    def choose(self, features: Tensor, m: int) -> tuple[Tensor, Tensor]:
        """Choose points greedily; see ``TaskNetSampler.choose``."""
        if self.weighting == "gradient":
            # Weights w ≥ 0 commute with the maximum.
            features = features * self._weights(features)[:, None]
        return facility_location(features, m)

    def _weights(self, features: Tensor) -> Tensor:
        """Return the weights ``(B, C)`` of the channels."""
        # Lightning tests in inference mode, whose tensors cannot be differentiated.
        with torch.inference_mode(False), torch.enable_grad():
            pooled = features.amax(1).clone().requires_grad_()
            logits = self.net.from_pooled(pooled) if isinstance(self.net, PooledNet) else None
            if not isinstance(logits, Tensor) or logits.ndim != 2:
                raise UserError(
                    "weighting must be none, as net is no classifier with point features, got "
                    f"{self.weighting}."
                )
            (gradient,) = torch.autograd.grad(logits.log_softmax(1).amax(1).sum(), pooled)
        return gradient.abs()
