"""Datasets: procedural shapes, ModelNet40's HDF5 files, folders of meshes."""
