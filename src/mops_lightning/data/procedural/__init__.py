"""Procedural shapes, built from triangle meshes."""
