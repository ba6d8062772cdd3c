"""A net of a user, without an argument for channels."""

from torch import Tensor, nn


class PlainNet(nn.Module):
    """The largest features of the points, classified by one layer."""

    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.features = nn.Linear(3, 8)
        self.head = nn.Linear(8, num_classes)

    def forward(self, points: Tensor) -> Tensor:
        """Map ``(B, N, 3)`` points to ``(B, num_classes)`` logits."""
        return self.head(self.features(points).amax(1))
