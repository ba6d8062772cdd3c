"""Plain twins: direct implementations of the formulas, for comparison with the fast ones."""

import torch
from torch import Tensor, nn

from mops_lightning.samplers.mops import MOPSNet


class PlainMOPS(nn.Module):
    """MOPS-Net with convolutions over (B, C, N), a repeated global feature and a dense S.

    Args:
        sampler: the sampler whose weights are used.
    """

    def __init__(self, sampler: MOPSNet) -> None:
        super().__init__()
        self.features = _convolutions(sampler.features.mlp.layers)
        joined = torch.cat([sampler.rho_local.weight, sampler.rho_global.weight], 1)
        first = nn.Conv1d(joined.shape[1], joined.shape[0], 1, bias=False)
        first.weight.data.copy_(joined[:, :, None])
        m, channels = sampler.queries.weight.shape
        last = nn.Conv1d(channels, m, 1)
        last.weight.data.copy_(sampler.queries.weight[:, :, None])
        norm = sampler.rho_first[0]
        self.rho = nn.Sequential(first, norm, nn.ReLU(), _convolutions(sampler.rho), last)
        self.tau = sampler.tau_min

    def forward(self, points: Tensor) -> Tensor:
        """Map ``(B, N, 3)`` points to ``(B, m, 3)``."""
        local = self.features(points.mT)
        peak = local.amax(2, keepdim=True).expand_as(local)
        matrix = (self.rho(torch.cat([local, peak], 1)) / self.tau).softmax(2)
        return matrix @ points


def _convolutions(stack: nn.Sequential) -> nn.Sequential:
    layers: list[nn.Module] = []
    for layer in stack:
        if isinstance(layer, nn.Linear):
            convolution = nn.Conv1d(layer.in_features, layer.out_features, 1, bias=False)
            convolution.weight.data.copy_(layer.weight[:, :, None])
            layers.append(convolution)
        else:
            layers.append(nn.ReLU() if isinstance(layer, nn.ReLU) else layer)
    return nn.Sequential(*layers)


def plain_farthest_point_sample(points: Tensor, m: int) -> Tensor:
    """Return the rows ``(m,)`` of a farthest point sample of ``(N, 3)``, starting with row 0."""
    rows = torch.zeros(m, dtype=torch.int64, device=points.device)
    distance = torch.full((len(points),), torch.inf, device=points.device)
    for place in range(1, m):
        away = (points - points[rows[place - 1]]).square().sum(1)
        distance = torch.minimum(distance, away)
        rows[place] = distance.argmax()
    return rows
