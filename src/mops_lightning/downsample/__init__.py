"""``python -m mops_lightning.downsample``: clouds and meshes from files, downsampled into files."""
