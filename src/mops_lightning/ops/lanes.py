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

WHOLE, WHOLE_BITS = 2.0**52, 0x4330000000000000
"""The bits of 2⁵² + k, for whole k ≥ 0, are those of 2⁵² plus k."""

INDEX, INTEGER, FLOAT = ir.IntType(32), ir.IntType(64), ir.DoubleType()
INTEGERS, FLOATS = ir.VectorType(INTEGER, LANES), ir.VectorType(FLOAT, LANES)


def _constant(kind, value):
    return ir.Constant(kind, [value] * LANES)


def _spread(builder, value):
    """Return a vector of one value."""
    vector = ir.VectorType(value.type, LANES)
    unknown = ir.Constant(vector, ir.Undefined)
    first = builder.insert_element(unknown, value, INDEX(0))
    return builder.shuffle_vector(first, unknown, _constant(ir.VectorType(INDEX, LANES), 0))


def _call(builder, name, result, operand):
    """Call a function of LLVM with one operand."""
    function = ir.FunctionType(result, [operand.type])
    return builder.call(builder.module.declare_intrinsic(name, (), function), [operand])


class _Arrays:
    """Pointers into the arrays of a call: C planes of coordinates, and the crowding."""

    def __init__(self, context, builder, signature, arguments):
        planes, self.total, self.axes, crowding = arguments[:4]
        self.builder = builder
        self.planes = context.make_array(signature.args[0])(context, builder, planes).data
        self.crowding = context.make_array(signature.args[3])(context, builder, crowding).data

    def crowding_at(self, place):
        """Return a pointer to the crowding of eight points."""
        pointer = self.builder.gep(self.crowding, [place])
        return self.builder.bitcast(pointer, INTEGERS.as_pointer())

    def square(self, axis, place, other):
        """Return the squares of the differences of eight points to another one along an axis."""
        builder = self.builder
        plane = builder.mul(axis, self.total)
        pointer = builder.gep(self.planes, [builder.add(plane, place)])
        here = builder.load(builder.bitcast(pointer, FLOATS.as_pointer()), align=8)
        there = builder.load(builder.gep(self.planes, [builder.add(plane, other)]))
        difference = builder.fsub(here, _spread(builder, there))
        return builder.fmul(difference, difference)

    def squares(self, place, other):
        """Return the squared distances of eight points to another one, summed axis by axis."""
        builder = self.builder
        squares = cgutils.alloca_once(builder, FLOATS)
        first = self.square(INTEGER(0), place, other)
        second = builder.fadd(first, self.square(INTEGER(1), place, other))
        builder.store(builder.fadd(second, self.square(INTEGER(2), place, other)), squares)
        with cgutils.for_range_slice(builder, INTEGER(3), self.axes, INTEGER(1)) as (axis, _):
            more = self.square(axis, place, other)
            builder.store(builder.fadd(builder.load(squares), more), squares)
        return builder.load(squares)


def _weights(builder, squares, inverse, scale):
    """Return ⌊(1 − d/reach)⁸ · scale⌋, 0 from the reach on; a product with 1/reach is faster."""
    zero, one = _constant(FLOATS, 0.0), _constant(FLOATS, 1.0)
    distances = _call(builder, f"llvm.sqrt.v{LANES}f64", FLOATS, squares)
    shares = builder.fsub(one, builder.fmul(distances, inverse))
    shares = builder.select(builder.fcmp_ordered(">", shares, zero), shares, zero)
    shares = builder.fmul(shares, shares)
    shares = builder.fmul(shares, shares)
    scaled = builder.fmul(builder.fmul(shares, shares), scale)
    floors = _call(builder, f"llvm.floor.v{LANES}f64", FLOATS, scaled)
    bits = builder.bitcast(builder.fadd(floors, _constant(FLOATS, WHOLE)), INTEGERS)
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
        signature = whole(planes, whole, whole, crowding, whole, whole, whole, real, real)

        def generate(context, builder, signature, arguments):
            arrays = _Arrays(context, builder, signature, arguments)
            start, stop, other, inverse, scale = arguments[4:]
            inverse, scale = _spread(builder, inverse), _spread(builder, scale)
            results = cgutils.alloca_once_value(builder, _constant(INTEGERS, start_value))
            with cgutils.for_range_slice(builder, start, stop, INTEGER(LANES)) as (place, _):
                weights = _weights(builder, arrays.squares(place, other), inverse, scale)
                pointer = arrays.crowding_at(place)
                crowding = builder.load(pointer, align=8)
                changed, result = change(builder, crowding, weights, builder.load(results))
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
