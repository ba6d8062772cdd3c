"""Crowding weights of eight points at a time, as vectors of LLVM.

Numba does not vectorise loops over the few points of a block: it handles their rest one by one.
Processors without vectors of 512 bits process the eight lanes in several instructions, with the
same results.
"""

# mypy: disable-error-code="no-untyped-def"

from typing import Any, cast

from llvmlite import ir
from numba import extending, types
from numba.core import cgutils

LANES = 8

WHOLE = 2.0**52
WHOLE_BITS = 0x4330000000000000
"""The bits of 2⁵² + k, for whole k ≥ 0, are those of 2⁵² plus k."""

INDEX = ir.IntType(32)
INTEGER = ir.IntType(64)
FLOAT = ir.DoubleType()
INTEGERS = ir.VectorType(INTEGER, LANES)
FLOATS = ir.VectorType(FLOAT, LANES)


def _constant(kind, value):
    return ir.Constant(kind, [value] * LANES)


def _spread(builder, value):
    """Return a vector of one value."""
    vector = ir.VectorType(value.type, LANES)
    unknown = ir.Constant(vector, ir.Undefined)
    first = builder.insert_element(unknown, value, INDEX(0))
    zeros = _constant(ir.VectorType(INDEX, LANES), 0)
    return builder.shuffle_vector(first, unknown, zeros)


def _call(builder, name, result, operand):
    """Call a function of LLVM with one operand."""
    function = ir.FunctionType(result, [operand.type])
    intrinsic = builder.module.declare_intrinsic(name, (), function)
    return builder.call(intrinsic, [operand])


class _Arrays:
    """Pointers into the arrays of a call: C planes of coordinates, and the crowding."""

    def __init__(self, context, builder, signature, arguments):
        planes, self.total, self.axes, crowding = arguments[:4]
        self.builder = builder
        make_planes = context.make_array(signature.args[0])
        make_crowding = context.make_array(signature.args[3])
        self.planes = make_planes(context, builder, planes).data
        self.crowding = make_crowding(context, builder, crowding).data

    def crowding_at(self, place):
        """Return a pointer to the crowding of eight points."""
        pointer = self.builder.gep(self.crowding, [place])
        return self.builder.bitcast(pointer, INTEGERS.as_pointer())

    def square(self, axis, place, other):
        """Return the squares of the differences of eight points to another one along an axis."""
        builder = self.builder
        plane = builder.mul(axis, self.total)
        here_at = builder.gep(self.planes, [builder.add(plane, place)])
        there_at = builder.gep(self.planes, [builder.add(plane, other)])
        here = builder.load(builder.bitcast(here_at, FLOATS.as_pointer()), align=8)
        there = builder.load(there_at)
        difference = builder.fsub(here, _spread(builder, there))
        return builder.fmul(difference, difference)

    def squares(self, place, other):
        """Return the squared distances of eight points to another one, summed axis by axis."""
        builder = self.builder
        squares = cgutils.alloca_once(builder, FLOATS)
        along_x = self.square(INTEGER(0), place, other)
        along_y = self.square(INTEGER(1), place, other)
        along_z = self.square(INTEGER(2), place, other)
        in_plane = builder.fadd(along_x, along_y)
        builder.store(builder.fadd(in_plane, along_z), squares)
        more_axes = cgutils.for_range_slice(builder, INTEGER(3), self.axes, INTEGER(1))
        with more_axes as (axis, _):
            more = self.square(axis, place, other)
            total = builder.load(squares)
            builder.store(builder.fadd(total, more), squares)
        return builder.load(squares)


def _weights(builder, squares, inverse, scale):
    """Return ⌊(1 − d/reach)⁸ · scale⌋, 0 from the reach on; a product with 1/reach is faster."""
    zero = _constant(FLOATS, 0.0)
    one = _constant(FLOATS, 1.0)
    whole = _constant(FLOATS, WHOLE)
    distances = _call(builder, f"llvm.sqrt.v{LANES}f64", FLOATS, squares)
    shares = builder.fsub(one, builder.fmul(distances, inverse))
    is_positive = builder.fcmp_ordered(">", shares, zero)
    shares = builder.select(is_positive, shares, zero)
    shares = builder.fmul(shares, shares)
    shares = builder.fmul(shares, shares)
    shares = builder.fmul(shares, shares)
    scaled = builder.fmul(shares, scale)
    floors = _call(builder, f"llvm.floor.v{LANES}f64", FLOATS, scaled)
    bits = builder.bitcast(builder.fadd(floors, whole), INTEGERS)
    return builder.sub(bits, _constant(INTEGERS, WHOLE_BITS))


def _larger(builder, a, b):
    return builder.select(builder.icmp_signed(">", a, b), a, b)


def _over_lanes(start_value, reduction, change):
    """Return a function for compiled loops that changes the crowding of the points of a block.

    Args:
        start_value: of the result, before the first eight points.
        reduction: function of LLVM that turns eight results into one.
        change: takes a builder, crowding, weights and results so far of eight points; returns the
            new crowding and the new results.
    """

    def typed(typing, planes, total, axes, crowding, start, stop, other, inverse, scale):
        whole, real = types.int64, types.float64
        places = (whole, whole, whole)
        signature = whole(planes, whole, whole, crowding, *places, real, real)

        def generate(context, builder, signature, arguments):
            arrays = _Arrays(context, builder, signature, arguments)
            start, stop, other, inverse, scale = arguments[4:]
            inverse = _spread(builder, inverse)
            scale = _spread(builder, scale)
            results = cgutils.alloca_once_value(builder, _constant(INTEGERS, start_value))
            blocks = cgutils.for_range_slice(builder, start, stop, INTEGER(LANES))
            with blocks as (place, _):
                squares = arrays.squares(place, other)
                weights = _weights(builder, squares, inverse, scale)
                pointer = arrays.crowding_at(place)
                crowding = builder.load(pointer, align=8)
                so_far = builder.load(results)
                changed, result = change(builder, crowding, weights, so_far)
                builder.store(changed, pointer, align=8)
                builder.store(result, results)
            name = f"llvm.vector.reduce.{reduction}.v{LANES}i64"
            return _call(builder, name, INTEGER, builder.load(results))

        return signature, generate

    return cast(Any, extending.intrinsic)(typed)


def _added(builder, crowding, weights, total):
    return builder.add(crowding, weights), builder.add(total, weights)


def _taken(builder, crowding, weights, largest):
    less = builder.sub(crowding, weights)
    return less, _larger(builder, less, largest)


add_weights = _over_lanes(0, "add", _added)
"""Add the weights of the distances to another point to the crowding; return their sum.

Arguments: coordinates ``(C·P,)`` of P points, one axis after the other; P; C, at least 3; the
crowding ``(P,)``; the first place, and the end, a multiple of eight further; the place of the other
point; 1/reach; the scale of the weights.
"""

take_weights = _over_lanes(-(2**63), "smax", _taken)
"""Subtract the weights instead; return the largest crowding that is left."""
