"""The innermost loops of the renderer, sixteen pixels at a time, written as vector instructions for numba.

LLVM does not make good vector code of loops over a handful of pixels: it adds run-time checks, a remainder
loop and scalar row limits that cost more than the pixels. So the loop over the rows of a strip of 16 pixels
is written here with LLVM's own vector type. It is compiled for whatever the processor has (one 512-bit
register, two of 256 or four of 128 bits). Pixels outside the ellipse add exactly nothing.

A strip is `n_rows` rows of an image, each of 16 neighbouring pixels from `first` on, `pitch` apart. In row n,
at dx = dx_0 + n (in pixels from the Gaussian's centre), pixel l has u = u_0 + l - slope dx and the exponent

    e = e_0 + q_x dx^2 + q_u u^2

which is a sum of terms that are not positive: nothing cancels, however flat the ellipse. Pixels with e >= limit
count. exp(e) is a polynomial of e/16, squared four times: within 2e-7 absolutely for e in [-18, 0].
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import extending
from numba.core import cgutils, types

intrinsic: Any = extending.intrinsic  # its stub counts the typing context among the arguments of a call

N_LANES = 16

_F32 = ir.FloatType()
_VECTOR = ir.VectorType(_F32, N_LANES)
_CONTRACT = ("contract",)
"""Products and sums may become fused multiply-adds."""

_STRIP = ("first", "pitch", "n_rows", "e_0", "q_x", "q_u", "slope", "dx_0", "u_0", "limit")
_STRIP_TYPES = (types.int64,) * 3 + (types.float32,) * 7
_IMAGE = types.Array(types.float32, 1, "C")


class _Strip:
    """Emits the code for one strip: constants in front of the loop, and what a row needs inside it."""

    def __init__(self, context: Any, builder: Any, values: Any) -> None:
        image, *rest = values
        self.builder, self.given = builder, dict(zip(_STRIP, rest, strict=True))
        self.pixels = context.make_array(_IMAGE)(context, builder, image).data
        lanes = ir.Constant(_VECTOR, [float(n) for n in range(N_LANES)])
        self.u_0 = self.add(lanes, self.splat(self.given["u_0"]))
        self.q_u, self.limit = self.splat(self.given["q_u"]), self.splat(self.given["limit"])
        self.zero = self.constant(0.0)

    def constant(self, value: float) -> Any:
        return ir.Constant(_VECTOR, [value] * N_LANES)

    def splat(self, scalar: Any) -> Any:
        one = self.builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), scalar, ir.IntType(32)(0))
        return self.builder.shuffle_vector(
            one, ir.Constant(_VECTOR, ir.Undefined), ir.Constant(ir.VectorType(ir.IntType(32), N_LANES), None)
        )

    def add(self, a: Any, b: Any) -> Any:
        return self.builder.fadd(a, b, flags=_CONTRACT)

    def mul(self, a: Any, b: Any) -> Any:
        return self.builder.fmul(a, b, flags=_CONTRACT)

    def scalar_dx(self, row: Any) -> Any:
        return self.add(self.given["dx_0"], self.builder.sitofp(row, _F32))

    def pointer(self, row: Any) -> Any:
        index = self.builder.add(self.given["first"], self.builder.mul(row, self.given["pitch"]))
        return self.builder.bitcast(self.builder.gep(self.pixels, [index]), _VECTOR.as_pointer())

    def load(self, pointer: Any) -> Any:
        value = self.builder.load(pointer)
        value.align = 4
        return value

    def bell(self, dx: Any) -> Any:
        """exp(e) of the sixteen pixels of a row, zero outside the ellipse."""
        across = self.add(self.given["e_0"], self.mul(self.given["q_x"], self.mul(dx, dx)))
        shift = self.builder.fneg(self.mul(self.given["slope"], dx))
        u = self.add(self.u_0, self.splat(shift))
        e = self.add(self.splat(across), self.mul(self.mul(u, self.q_u), u))
        t = self.mul(e, self.constant(1 / 16))
        value = self.constant(1 / 120)
        for coefficient in (1 / 24, 1 / 6, 1 / 2, 1.0, 1.0):
            value = self.add(self.mul(value, t), self.constant(coefficient))
        for _ in range(4):
            value = self.mul(value, value)
        inside = self.builder.fcmp_ordered(">=", e, self.limit)
        return self.builder.select(inside, value, self.zero)

    def total(self, vector: Any) -> Any:
        """Sum of the sixteen lanes, by halves."""
        width = N_LANES
        while width > 1:
            width //= 2
            index = ir.VectorType(ir.IntType(32), width)
            low = ir.Constant(index, list(range(width)))
            high = ir.Constant(index, list(range(width, 2 * width)))
            undefined = ir.Constant(vector.type, ir.Undefined)
            vector = self.add(
                self.builder.shuffle_vector(vector, undefined, low),
                self.builder.shuffle_vector(vector, undefined, high),
            )
        return self.builder.extract_element(vector, ir.IntType(32)(0))


@intrinsic
def add_strip(typing_context, image, first, pitch, n_rows, e_0, q_x, q_u, slope, dx_0, u_0, limit, height):
    """Add height exp(e) to the image on a strip."""

    def emit(context, builder, signature, values):
        strip = _Strip(context, builder, values[:-1])
        height = strip.splat(values[-1])
        with cgutils.for_range(builder, strip.given["n_rows"]) as loop:
            bell = strip.bell(strip.scalar_dx(loop.index))
            pointer = strip.pointer(loop.index)
            pixels = strip.add(strip.load(pointer), strip.mul(height, bell))
            builder.store(pixels, pointer).align = 4
        return context.get_dummy_value()

    return types.void(_IMAGE, *_STRIP_TYPES, types.float32), emit


@intrinsic
def strip_sum(typing_context, image, first, pitch, n_rows, e_0, q_x, q_u, slope, dx_0, u_0, limit):
    """Sum of image exp(e) over a strip."""

    def emit(context, builder, signature, values):
        strip = _Strip(context, builder, values)
        total = cgutils.alloca_once_value(builder, strip.zero)
        with cgutils.for_range(builder, strip.given["n_rows"]) as loop:
            bell = strip.bell(strip.scalar_dx(loop.index))
            product = strip.mul(strip.load(strip.pointer(loop.index)), bell)
            builder.store(strip.add(builder.load(total), product), total)
        return strip.total(builder.load(total))

    return types.float32(_IMAGE, *_STRIP_TYPES), emit


@intrinsic
def strip_moments(typing_context, image, first, pitch, n_rows, e_0, q_x, q_u, slope, dx_0, u_0, limit, dy_0):
    """Sums of w, w dx, w dy, w dx^2, w dx dy, w dy^2 over a strip, w = image exp(e); lane l has dy_0 + l."""

    def emit(context, builder, signature, values):
        strip = _Strip(context, builder, values[:-1])
        # dy depends on the lane and not on the row: three sums in the loop, the others at its end
        sums = [cgutils.alloca_once_value(builder, strip.zero) for _ in range(3)]
        with cgutils.for_range(builder, strip.given["n_rows"]) as loop:
            dx = strip.scalar_dx(loop.index)
            term = strip.mul(strip.load(strip.pointer(loop.index)), strip.bell(dx))
            wide = strip.splat(dx)
            for n in range(3):
                if n:
                    term = strip.mul(term, wide)
                builder.store(strip.add(builder.load(sums[n]), term), sums[n])
        w, w_x, w_xx = (builder.load(one) for one in sums)
        dy = strip.add(ir.Constant(_VECTOR, [float(n) for n in range(N_LANES)]), strip.splat(values[-1]))
        w_y = strip.mul(w, dy)
        vectors = (w, w_x, w_y, w_xx, strip.mul(w_x, dy), strip.mul(w_y, dy))
        return context.make_tuple(builder, signature.return_type, [strip.total(v) for v in vectors])

    return types.UniTuple(types.float32, 6)(_IMAGE, *_STRIP_TYPES, types.float32), emit
