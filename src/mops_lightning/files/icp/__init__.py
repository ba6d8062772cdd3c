"""Comparing methods of downsampling by the registration of scans with small_gicp."""
