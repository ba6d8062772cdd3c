"""Task-oriented point cloud downsampling: MOPS-Net and its rivals on Lightning and Hydra."""
