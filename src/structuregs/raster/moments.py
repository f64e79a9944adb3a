"""Sums over the lanes of vectors, as LLVM instructions.

Written as loops they become gathers or scalars, and take as long as all the rest of the blend's backward pass.
"""

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

LANES = 16
COUNT = 10  # sums that `lane_moments` writes
_VECTOR = ir.VectorType(ir.FloatType(), LANES)
_CENTRED = [x - (LANES - 1) / 2 for x in range(LANES)]


def _constant(values: list[float]) -> ir.Constant:
    return ir.Constant(_VECTOR, values)


def _halved(builder, a, b, segment: int):
    """Folds the segments of two vectors upon their own halves: all of a's, then all of b's, each half as long."""
    places = [s + x for s in range(0, 2 * LANES, segment) for x in range(segment // 2)]
    low, high = (
        builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), LANES), [p + shift for p in places]))
        for shift in (0, segment // 2)
    )
    return builder.fadd(low, high)


@intrinsic
def lane_moments(typingctx, table, start, out):  # noqa: ARG001
    """Writes sums over 16 lanes to `out` (10): of s0, s0 x, s1, s0 x^2, s1 x, s2, s3, s4, s5, s6.

    Row s_r is `table[start + 16 r:][:16]`, float32; x counts the lanes from their middle, -7.5 to 7.5.
    All ten are folded together: eleven additions of vectors, of which each halves what is left of two.
    """

    def generate(context, builder, signature, arguments):
        source, target = (context.make_array(signature.args[i])(context, builder, arguments[i]).data for i in (0, 2))

        def row(r: int):
            place = builder.add(arguments[1], ir.Constant(arguments[1].type, LANES * r))
            return builder.load(builder.bitcast(builder.gep(source, [place]), _VECTOR.as_pointer()), align=4)

        s = [row(r) for r in range(7)]
        x = _constant(_CENTRED)
        first = builder.fmul(s[0], x)
        terms = [s[0], first, s[1], builder.fmul(first, x), builder.fmul(s[1], x), *s[2:]]
        segment = LANES
        while len(terms) > 1:
            terms += [_constant([0.0] * LANES)] * (len(terms) % 2)
            terms = [_halved(builder, a, b, segment) for a, b in zip(terms[::2], terms[1::2], strict=True)]
            segment //= 2
        for first_lane, width in ((0, 8), (8, 2)):
            lanes = ir.Constant(ir.VectorType(ir.IntType(32), width), list(range(first_lane, first_lane + width)))
            place = builder.gep(target, [ir.Constant(ir.IntType(64), first_lane)])
            pointer = builder.bitcast(place, ir.VectorType(ir.FloatType(), width).as_pointer())
            builder.store(builder.shuffle_vector(terms[0], terms[0], lanes), pointer, align=4)
        return context.get_dummy_value()

    return types.void(table, types.intp, out), generate
