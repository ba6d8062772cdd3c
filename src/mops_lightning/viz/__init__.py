"""Figures of clouds, sampling matrices, pairs and reconstructions."""
