"""Point cloud file formats."""
