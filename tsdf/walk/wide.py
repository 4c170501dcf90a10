"""What processors do with many numbers at once, and the compiler does not see by itself: for kernels of facets.

Boxes of WIDE facets against one, and the three edges of a facet against a line. On processors whose registers are
shorter the compiler takes several.
"""

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
from numba.extending import intrinsic

WIDE = 32  # boxes that are looked at together
BYTE, WORD, LONG = (ir.IntType(bits) for bits in (8, 32, 64))
BYTES, WORDS = ir.VectorType(BYTE, 4 * WIDE), ir.VectorType(WORD, WIDE)
REALS, NUMBERS = ir.VectorType(ir.DoubleType(), 4), ir.VectorType(WORD, 4)


def _place(context: Any, builder: Any, kind: Any, array: Any, at: Any, vector: Any) -> Any:
    """Return the address of a vector that begins at a number of an array."""
    data = cgutils.create_struct_proxy(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [at]), vector.as_pointer())


def _every(builder: Any, x: Any, vector: Any) -> Any:
    """Return a vector that has one number in each place."""
    one = builder.insert_element(ir.Constant(vector, ir.Undefined), x, WORD(0))
    return builder.shuffle_vector(one, one, ir.Constant(ir.VectorType(WORD, vector.count), [0] * vector.count))


@intrinsic
def bring(typing: Any, array: Any, at: Any) -> Any:
    """Have the processor bring a number of an array into its cache, as `compiled.fetch` does the first; what is not in
    the array is nothing to it."""

    def written(context: Any, builder: Any, kind: Any, args: Any) -> Any:
        hint = ir.FunctionType(ir.VoidType(), (BYTE.as_pointer(), WORD, WORD, WORD))
        hint = cgutils.get_or_insert_function(builder.module, hint, "llvm.prefetch.p0i8")
        builder.call(hint, (_place(context, builder, kind.args[0], args[0], args[1], BYTE), WORD(0), WORD(3), WORD(1)))
        return context.get_dummy_value()

    return types.none(array, types.int64), written


@intrinsic
def over(typing: Any, words: Any, at: Any, least: Any) -> Any:
    """Return which of WIDE words of an array, from one on, are in each of their bytes at least what another word is
    there: a bit for each."""

    def written(context: Any, builder: Any, kind: Any, args: Any) -> Any:
        its = builder.load(_place(context, builder, kind.args[0], args[0], args[1], WORDS), align=4)
        every = builder.bitcast(_every(builder, args[2], WORDS), BYTES)
        parts = builder.bitcast(its, BYTES)
        larger = builder.select(builder.icmp_unsigned(">=", parts, every), parts, every)
        same = builder.icmp_unsigned("==", builder.bitcast(larger, WORDS), its)
        return builder.zext(builder.bitcast(same, ir.IntType(WIDE)), LONG)

    return types.int64(words, types.int64, types.uint32), written


@intrinsic
def lowest(typing: Any, bits: Any) -> Any:
    """Return the number of the lowest bit that is set, of a whole number that is not 0."""
    return types.int64(types.int64), lambda context, builder, kind, args: builder.cttz(args[0], ir.IntType(1)(1))


@intrinsic
def turned(typing: Any, facets: Any, row: Any, axes: Any, p: Any, slope: Any) -> Any:
    """Return whether a line passes within a facet, a row of `grid.Grid.facets`: whether the facet's corners, seen along
    it, turn around it all one way (Woop et al. 2013).

    A line is the numbers of two axes and of that along which it runs most, a point of it in that order, and how far it
    goes along the two for each unit along the third. Of an edge that it meets, one of the two facets there sees it on
    the one side and the other on the other, for the ends of an edge change their roles.
    """

    def written(context: Any, builder: Any, kind: Any, args: Any) -> Any:
        begin = builder.shl(args[1], LONG(4))

        def less(which: int) -> Any:
            """Return how far the corners are from the point along an axis."""
            rows = builder.shl(builder.add(builder.extract_value(args[2], which), LONG(1)), LONG(2))
            place = _place(context, builder, kind.args[0], args[0], builder.add(begin, rows), REALS)
            point = _every(builder, builder.extract_value(args[3], which), REALS)
            return builder.fsub(builder.load(place, align=8), point)

        def aside(which: int) -> Any:
            """Return how far they are from the line along an axis."""
            slope = _every(builder, builder.extract_value(args[4], which), REALS)
            return builder.fsub(less(which), builder.fmul(slope, far))

        def following(x: Any) -> Any:
            return builder.shuffle_vector(x, x, ir.Constant(NUMBERS, [1, 2, 0, 3]))

        far = less(2)
        x, y = aside(0), aside(1)
        u, v = following(x), following(y)
        area, nothing = builder.fsub(builder.fmul(x, v), builder.fmul(y, u)), ir.Constant(REALS, [0.0] * 4)
        before = builder.and_(builder.fcmp_ordered("==", x, u), builder.fcmp_ordered("<", y, v))
        before = builder.or_(builder.fcmp_ordered("<", x, u), before)
        before = builder.and_(builder.fcmp_ordered("==", area, nothing), before)
        left = builder.or_(builder.fcmp_ordered(">", area, nothing), before)
        three = builder.and_(builder.bitcast(left, ir.IntType(4)), ir.IntType(4)(7))
        return builder.or_(*(builder.icmp_unsigned("==", three, ir.IntType(4)(all_)) for all_ in (0, 7)))

    numbers, reals = types.UniTuple(types.int64, 3), types.UniTuple(types.float64, 3)
    return types.boolean(facets, types.int64, numbers, reals, types.UniTuple(types.float64, 2)), written
