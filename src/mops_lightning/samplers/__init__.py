"""Samplers: plain torch modules that turn ``(B, N, 3)`` points into ``(B, M, 3)``."""
