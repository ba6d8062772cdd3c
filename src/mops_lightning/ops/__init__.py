"""Pure functions on point clouds."""
