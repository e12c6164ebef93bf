"""Numba kernels of the renderer, forward: shapes, projection of Gaussians onto planes, pixels (G3R Eq. 3-5).

The backward pass is in `kernels_backward`. Mathematics as in docs/method.md, "Gaussians". A projection is computed in
float64 (a nearly flat Gaussian has a condition number of 1e6, beyond float32) and rasterised in float32 (`simd`).
A plane is rasterised in a worker's own small image whose rows are padded, so that sixteen pixels at a time may run over
the end of a row. Each worker takes every n-th plane; the sums of a pixel do not depend on the number of workers.

Arguments named `cloud`, `planes`, `overlaps` and `work` are the named tuples of `arrays`. `cut` is the square of the
cut-off in sigma; `exact` says whether the height is attenuated by B = sqrt(|Sigma| / |S|).
"""

from __future__ import annotations

import math

import numba
import numpy as np

from g3r.gaussians.simd import N_LANES, add_strip

f32 = np.float32

LOOSE = {"contract", "arcp", "nsz"}
"""Fast-math flags of the compiler; NaN is preserved, because comparisons guard against it."""

SHAPE_COLUMNS = 10
"""Columns of a Gaussian's derived shape: mean (3), covariance xx xy xz yy yz zz, s1 s2 s3."""

MAX_PIXELS = 1e9
"""Ellipses that reach further are not drawn: pixels are counted in 32 bits. `render` refuses them."""

N_GRADIENTS = 11
"""Gradient columns of a Gaussian: amplitude, mean (3), covariance xx xy xz yy yz zz, log-volume."""

N_PLANE_GRADIENTS = 7
"""Gradient columns of a plane: body-frame rotation (3), world translation (3), log-gain."""

PROJECTION = np.dtype(
    [
        ("unit", np.float32),
        ("e_0", np.float32),
        ("q_x", np.float32),
        ("q_u", np.float32),
        ("slope", np.float32),
        ("x", np.float32),
        ("y", np.float32),
        ("half_x", np.float32),
        ("half_y", np.float32),
        ("row", np.int32),
        ("column", np.int32),
        ("gaussian", np.int32),
    ]
)
"""A projection: the 2D Gaussian that a 3D Gaussian leaves on a plane, in pixels.

Height over the amplitude (with gain); exponent as in `simd`; centre at (row + x, column + y); half the sides of the box
around the ellipse at the cut-off; number of the Gaussian.
"""


@numba.njit(forceinline=True, fastmath=LOOSE)
def observe(shapes, j, r, t, psf):
    """The observed Gaussian (G3R Eq. 4) in the frame of a plane: m = R^T (mu - t), S = R^T Sigma R + D_psf."""
    dx, dy, dz = shapes[j, 0] - t[0], shapes[j, 1] - t[1], shapes[j, 2] - t[2]
    mx = r[0, 0] * dx + r[1, 0] * dy + r[2, 0] * dz
    my = r[0, 1] * dx + r[1, 1] * dy + r[2, 1] * dz
    mz = r[0, 2] * dx + r[1, 2] * dy + r[2, 2] * dz
    a, b, c, d, e, f = shapes[j, 3], shapes[j, 4], shapes[j, 5], shapes[j, 6], shapes[j, 7], shapes[j, 8]
    u0 = a * r[0, 0] + b * r[1, 0] + c * r[2, 0]
    u1 = b * r[0, 0] + d * r[1, 0] + e * r[2, 0]
    u2 = c * r[0, 0] + e * r[1, 0] + f * r[2, 0]
    v0 = a * r[0, 1] + b * r[1, 1] + c * r[2, 1]
    v1 = b * r[0, 1] + d * r[1, 1] + e * r[2, 1]
    v2 = c * r[0, 1] + e * r[1, 1] + f * r[2, 1]
    w0 = a * r[0, 2] + b * r[1, 2] + c * r[2, 2]
    w1 = b * r[0, 2] + d * r[1, 2] + e * r[2, 2]
    w2 = c * r[0, 2] + e * r[1, 2] + f * r[2, 2]
    sxx = r[0, 0] * u0 + r[1, 0] * u1 + r[2, 0] * u2 + psf[0]
    sxy = r[0, 0] * v0 + r[1, 0] * v1 + r[2, 0] * v2
    sxz = r[0, 0] * w0 + r[1, 0] * w1 + r[2, 0] * w2
    syy = r[0, 1] * v0 + r[1, 1] * v1 + r[2, 1] * v2 + psf[1]
    syz = r[0, 1] * w0 + r[1, 1] * w1 + r[2, 1] * w2
    szz = r[0, 2] * w0 + r[1, 2] * w1 + r[2, 2] * w2 + psf[2]
    return mx, my, mz, sxx, sxy, sxz, syy, syz, szz


@numba.njit(forceinline=True, fastmath=LOOSE)
def project(shapes, planes, overlaps, k, cut, exact, projections):
    """Project the Gaussians that touch plane k (G3R Eq. 5), one after the other; returns their number.

    On u_z = 0 the observed 3D Gaussian is a 2D Gaussian of exponent -m_z^2 / 2 S_zz at its centre
    m_xy - S_xy,z m_z / S_zz, with covariance S_xy,xy - S_xy,z S_z,xy / S_zz.
    """
    r, t, psf, gain = planes.rotation[k], planes.center[k], planes.psf[k], planes.gain[k]
    n_x, n_y = planes.shape[k, 0], planes.shape[k, 1]
    sx, sy = planes.spacing[k, 0], planes.spacing[k, 1]
    over_x, over_y = 1.0 / sx, 1.0 / sy
    middle_x, middle_y = 0.5 * (n_x - 1), 0.5 * (n_y - 1)
    n = 0
    for pair in range(overlaps.start[k], overlaps.start[k + 1]):
        j = overlaps.order[pair]
        mx, my, mz, sxx, sxy, sxz, syy, syz, szz = observe(shapes, j, r, t, psf)
        iz = 1.0 / szz
        kx, ky = sxz * iz, syz * iz
        e_0 = -0.5 * mz * mz * iz
        c2 = cut + 2.0 * e_0
        cxx, cxy, cyy = sxx - kx * sxz, sxy - kx * syz, syy - ky * syz
        det = cxx * cyy - cxy * cxy
        if not (c2 > 0.0 and det > 0.0):
            continue
        px, py = (mx - kx * mz) * over_x + middle_x, (my - ky * mz) * over_y + middle_y
        half_x, half_y = math.sqrt(c2 * cxx) * over_x, math.sqrt(c2 * cyy) * over_y
        if not (px + half_x >= 0.0 and py + half_y >= 0.0 and px - half_x < n_x and py - half_y < n_y):
            continue
        if not (half_x < MAX_PIXELS and half_y < MAX_PIXELS):
            continue
        unit = gain
        if exact:
            unit *= shapes[j, 9] * math.sqrt(iz / det)
        over_cxx = 1.0 / cxx
        row, column = math.floor(px), math.floor(py)
        record = projections[n]
        record.unit = f32(unit)
        record.e_0 = f32(e_0)
        record.q_x = f32(-0.5 * sx * sx * over_cxx)
        record.q_u = f32(-0.5 * sy * sy * cxx / det)
        record.slope = f32(cxy * over_cxx * sx * over_y)
        record.x, record.y = f32(px - row), f32(py - column)
        record.half_x, record.half_y = f32(half_x), f32(half_y)
        record.row, record.column, record.gaussian = row, column, j
        n += 1
    return n


@numba.njit(forceinline=True, fastmath=LOOSE)
def strip_rows(record, cut, first, last, n_x):
    """First row and number of rows of the ellipse between two columns (given from its centre).

    The outermost row is that of the ellipse if its column is in the strip; else it is where a border cuts the ellipse.
    """
    hx, hy, slope = record.half_x, record.half_y, record.slope
    up, down = slope * hx, -slope * hx
    top, bottom = hx, -hx
    if not (first <= min(up, down) and max(up, down) <= last):
        c2 = f32(cut) + f32(2.0) * record.e_0
        over = f32(1.0) / (hy * hy)
        lean = slope * hx * hx * over
        narrow = hx * math.sqrt(f32(-0.5) * c2 / record.q_u) * over
        up, down = min(max(up, first), last), min(max(down, first), last)
        top = lean * up + narrow * math.sqrt(max(hy * hy - up * up, f32(0.0)))
        bottom = lean * down - narrow * math.sqrt(max(hy * hy - down * down, f32(0.0)))
    start = max(-record.row, math.ceil(record.x + bottom))
    stop = min(n_x - 1 - record.row, math.floor(record.x + top))
    return start, stop - start + 1


@numba.njit(forceinline=True, fastmath=LOOSE)
def strip_at(record, cut, column, stop, n_x, pitch):
    """A strip of the ellipse from a column on: its first pixel, number of rows, dx and dy of that pixel."""
    dy = f32(column) - record.y
    last = f32(min(column + N_LANES - 1, stop)) - record.y
    row, n_rows = strip_rows(record, cut, dy, last, n_x)
    return (record.row + row) * pitch + record.column + column, n_rows, f32(row) - record.x, dy


@numba.njit(forceinline=True)
def strip_columns(record, n_y):
    """First and last column of the ellipse on the plane, relative to the record's."""
    start = max(-record.column, math.ceil(record.y - record.half_y))
    stop = min(n_y - 1 - record.column, math.floor(record.y + record.half_y))
    return start, stop


@numba.njit(forceinline=True, fastmath=LOOSE)
def rasterise(projections, n, amplitude, cut, n_x, n_y, image):
    """Add `n` projections, times their amplitudes, to the padded image of their plane."""
    pitch = n_y + N_LANES
    limit = f32(-0.5 * cut)
    for i in range(n):
        record = projections[i]
        height = record.unit * f32(amplitude[record.gaussian])
        start, stop = strip_columns(record, n_y)
        for column in range(start, stop + 1, N_LANES):
            first, n_rows, dx, dy = strip_at(record, cut, column, stop, n_x, pitch)
            add_strip(
                image, first, pitch, n_rows, record.e_0, record.q_x, record.q_u, record.slope, dx, dy, limit, height
            )


@numba.njit(forceinline=True)
def clear(image, n_x, n_y):
    """Zero the padded image of a plane."""
    image[: n_x * (n_y + N_LANES) + N_LANES] = f32(0.0)


@numba.njit(forceinline=True)
def load(image, pixels, offset, n_x, n_y):
    """Copy the pixels of a plane into padded rows, zero in the padding."""
    pitch = n_y + N_LANES
    for x in range(n_x):
        begin, row = offset + x * n_y, x * pitch
        for y in range(n_y):  # an assignment of slices would compile numba's message about shapes, for seconds
            image[row + y] = pixels[begin + y]
        image[row + n_y : row + pitch] = f32(0.0)
    image[n_x * pitch : n_x * pitch + N_LANES] = f32(0.0)


@numba.njit(forceinline=True)
def unload(image, pixels, offset, n_x, n_y):
    """Copy the pixels of a plane from padded rows."""
    for x in range(n_x):
        begin, row = offset + x * n_y, x * (n_y + N_LANES)
        for y in range(n_y):
            pixels[begin + y] = image[row + y]


@numba.njit(parallel=True, nogil=True, cache=True)
def forward(cloud, planes, overlaps, cut, exact, work, out):
    """The sum of all Gaussians on each pixel, gain included (G3R Eq. 5), written to the flat pixels `out`."""
    n_workers = len(work.images)
    for worker in numba.prange(n_workers):
        image, mine = work.images[worker], work.projections[worker]
        for k in range(worker, len(planes.rotation), n_workers):
            n_x, n_y = planes.shape[k, 0], planes.shape[k, 1]
            clear(image, n_x, n_y)
            n = project(cloud.shapes, planes, overlaps, k, cut, exact, mine)
            rasterise(mine, n, cloud.amplitude, cut, n_x, n_y, image)
            unload(image, out, planes.offset[k], n_x, n_y)


@numba.njit(parallel=True, nogil=True, cache=True)
def derive_shapes(mean, log_scale, quaternion, shapes):
    """Centre, Sigma = R diag(s^2) R^T (G3R Eq. 3) and s1 s2 s3 of every Gaussian [N, 10], float64.

    Args:
        mean: [N, 3] mm from the cloud's origin.
        log_scale: [N, 3] ln mm.
        quaternion: [N, 4] w x y z, of any length but zero.
        shapes: [N, 10] is written; columns as `SHAPE_COLUMNS` says.
    """
    for j in numba.prange(len(log_scale)):
        r = quaternion_matrix(quaternion, j)
        s0, s1, s2 = math.exp(log_scale[j, 0]), math.exp(log_scale[j, 1]), math.exp(log_scale[j, 2])
        v0, v1, v2 = s0 * s0, s1 * s1, s2 * s2
        n = 3
        for a in range(3):
            shapes[j, a] = mean[j, a]
            for b in range(a, 3):
                shapes[j, n] = r[a][0] * r[b][0] * v0 + r[a][1] * r[b][1] * v1 + r[a][2] * r[b][2] * v2
                n += 1
        shapes[j, 9] = s0 * s1 * s2


@numba.njit(forceinline=True)
def quaternion_matrix(quaternion, j):
    """Rotation (tuple of rows) of quaternion j, which is normalised first."""
    w, x, y, z = (float(quaternion[j, 0]), float(quaternion[j, 1]), float(quaternion[j, 2]), float(quaternion[j, 3]))
    n = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * n, x * n, y * n, z * n
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
