"""Pure functions on tensors of point clouds."""
