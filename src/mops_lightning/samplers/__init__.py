"""Samplers: plain torch modules from ``(B, N, 3)`` to ``(B, M, 3)`` points."""
