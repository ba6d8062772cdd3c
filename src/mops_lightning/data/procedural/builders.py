"""The classes of the procedural dataset: one builder each, from a random generator to a mesh."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from numpy.random import Generator
from trimesh import Trimesh

from mops_lightning.data.procedural.airplane import airplane
from mops_lightning.data.procedural.beds import bed
from mops_lightning.data.procedural.furniture import desk, lamp, shelf, table
from mops_lightning.data.procedural.seats import chair, sofa, stool
from mops_lightning.data.procedural.vessels import bottle, bowl, bucket, cup, goblet, teapot, vase

BUILDERS: Mapping[str, Callable[[Generator], Trimesh]] = MappingProxyType(
    {
        builder.__name__: builder
        for builder in (
            airplane,
            bed,
            bottle,
            bowl,
            bucket,
            chair,
            cup,
            desk,
            goblet,
            lamp,
            shelf,
            sofa,
            stool,
            table,
            teapot,
            vase,
        )
    }
)
"""Builders by class name, in the order of the labels; each call draws new proportions."""
