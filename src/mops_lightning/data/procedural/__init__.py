"""Procedural shapes from triangle meshes."""
