"""The blend of 2D Gaussians in Numba: tile lists, image, gradients.

The image is cut into tiles of 16 x 16 pixels; a row of a tile is one vector.  The backward pass runs from near to far
as the forward pass does: what lies behind a splat is the final colour less all that came before, so nothing but the
final image is kept.  Every (tile, splat) pair has its own row of partial gradients, summed over the pairs of a splat in a
fixed order: no atomics, and the same bytes for any number of threads.
"""

import math

import numpy as np
from numba import prange

from ..jit import fast_exp2, kernel
from .moments import lane_moments
from .records import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE

TILE = 16
PARTIALS = 10  # moments of the exponent's gradient (1, x, y, xx, xy, yy), then the gradients of rgb and depth
_MIN_ALPHA, _MIN_T = np.float32(MIN_ALPHA), np.float32(MIN_TRANSMITTANCE)
_ZERO, _ONE, _TWO, _HALF = np.float32(0), np.float32(1), np.float32(2), np.float32(0.5)
_TINY = np.float32(1e-30)
_LOG2_E = np.float32(math.log2(math.e))
_LOWEST, _HIGHEST = np.float32(math.log2(MIN_ALPHA) - 0.01), np.float32(math.log2(MAX_ALPHA))
_SLACK = np.float32(1e-2)  # pixels; spans are rounded outwards, each pixel's own alpha decides
# Where the planes of a tile lie after that of transmittance; the last holds sums over columns.
_R, _G, _B, _D, _S, _SUMS = (plane * TILE * TILE for plane in range(1, 7))
_POSITIVE = 0x7FFFFFFF  # masks an index, so that the compiler need not think of negative ones
_CHECK = 16  # splats between two looks at whether a tile is full


@kernel(parallel=True)
def pack(xy, conic, opacity, rgb, depth, extent):
    """The blend's own tables of the splats, one cache line and half of one for each.

    The ellipse that a splat reaches is a u^2 + 2 b u v + c v^2 <= limit around its centre.  At a given u it spans
    v = -slope u +- sqrt(level - bend u^2), and v is largest at u = turn.

    Returns:
        drawing: (N 16) centre (with pixel centres at integers); a, b, c and peak of log2 alpha = peak + a dx^2 + b dx dy
            + c dy^2; rgb, depth; then for u = x: extent, turn, slope, level, bend.
        reach: (N 8) centre and extents; then for u = y: turn, slope, level, bend.
    """
    drawing, reach = np.empty((len(xy), 16), np.float32), np.empty((len(xy), 8), np.float32)
    for i in prange(len(xy)):
        a, b, c, o = conic[i, 0], conic[i, 1], conic[i, 2], opacity[i]
        ex, ey = extent[i, 0], extent[i, 1]
        limit = _TWO * np.float32(math.log(max(o / _MIN_ALPHA, _ONE)))
        d, r = drawing[i], reach[i]
        d[0], d[1] = xy[i, 0] - _HALF, xy[i, 1] - _HALF
        d[2], d[3], d[4] = -_HALF * _LOG2_E * a, -_LOG2_E * b, -_HALF * _LOG2_E * c
        d[5] = np.float32(math.log2(max(o, _TINY)))
        d[6], d[7], d[8], d[9] = rgb[i, 0], rgb[i, 1], rgb[i, 2], depth[i]
        # From the extents, not from a c - b^2, which cancels for thin ellipses.
        d[10], d[11], d[12], d[13], d[14] = ex, -b / a * ey, b / c, limit / c, limit / c / max(ex * ex, _TINY)
        r[0], r[1], r[2], r[3] = d[0], d[1], ex, ey
        r[4], r[5], r[6], r[7] = -b / c * ex, b / a, limit / a, limit / a / max(ey * ey, _TINY)
    return drawing, reach


@kernel()
def _ceil(x):
    """Smallest integer >= x for x >= 0; `math.ceil` is a call."""
    whole = np.int32(x)
    return whole + 1 if np.float32(whole) < x else whole


@kernel()
def _span(extent, turn, slope, level, bend, low, high):
    """Range of v of the ellipse's part with low <= u <= high (see `pack`), relative to the centre; empty as (1, 0)."""
    low, high = max(low - _SLACK, -extent), min(high + _SLACK, extent)
    if low > high:
        return _ONE, _ZERO
    u, w = min(max(turn, low), high), min(max(-turn, low), high)
    top = np.float32(math.sqrt(max(level - bend * u * u, _ZERO))) - slope * u
    bottom = np.float32(math.sqrt(max(level - bend * w * w, _ZERO))) + slope * w
    return -bottom - _SLACK, top + _SLACK


@kernel()
def _tile_columns(r, row, last):
    """First and one past the last tile that a splat reaches in a row of tiles; last: the image's last column."""
    v = np.float32(row * TILE) - r[1]
    left, right = _span(r[3], r[4], r[5], r[6], r[7], v, v + np.float32(TILE - 1))
    left, right = max(r[0] + left, _ZERO), min(r[0] + right, last)
    if not left <= right:
        return 0, 0
    # Pixels are at integers: a tile whose last pixel lies left of the span is not reached.
    return (_ceil(left) // TILE, np.int32(right) // TILE + 1)


@kernel()
def _tile_rows(r, down):
    """First and one past the last of `down` rows of tiles that a splat reaches; none where it is not drawn."""
    low, high = max(r[1] - r[3], _ZERO), min(r[1] + r[3], np.float32(down * TILE - 1))
    if not (low <= high and r[3] > _ZERO):
        return 0, 0
    return _ceil(low) // TILE, np.int32(high) // TILE + 1


@kernel()
def depth_order(depth, extent):
    """Indices of the drawn splats from near to far, ties by index: a radix sort of the floats' bits."""
    ids, keys = np.empty(len(depth), np.int32), np.empty(len(depth), np.uint32)
    n = 0
    for i in range(len(depth)):
        if extent[i, 0] > 0:
            bits = np.float32(depth[i]).view(np.uint32)
            ids[n] = i
            keys[n] = bits ^ (np.uint32(0xFFFFFFFF) if bits >> np.uint32(31) else np.uint32(0x80000000))
            n += 1
    ids, keys = ids[:n], keys[:n]
    ids_out, keys_out = np.empty_like(ids), np.empty_like(keys)
    for shift in (0, 11, 22):
        heads = np.zeros(2049, np.int64)
        for q in range(n):
            heads[((keys[q] >> np.uint32(shift)) & np.uint32(2047)) + 1] += 1
        for d in range(2048):
            heads[d + 1] += heads[d]
        for q in range(n):
            digit = (keys[q] >> np.uint32(shift)) & np.uint32(2047)
            ids_out[heads[digit]], keys_out[heads[digit]] = ids[q], keys[q]
            heads[digit] += 1
        ids, keys, ids_out, keys_out = ids_out, keys_out, ids, keys
    return ids


@kernel(parallel=True)
def tile_lists(reach, order, width, height, lanes):
    """Which splats each tile draws, from near to far; lanes: threads.

    All but the last round takes the splats as they lie in memory: only then is order asked for.

    Returns:
        starts: where each tile's list begins in `splats`, and the total (tiles + 1).
        splats: the lists, one after the other.
    """
    across, down = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    count, last = len(reach), np.float32(width - 1)
    rows = np.empty((count, 3), np.int32)  # first row of tiles, one past the last, and where the splat's spans begin
    total = 0
    for i in range(count):
        y0, y1 = _tile_rows(reach[i], down)
        rows[i, 0], rows[i, 1], rows[i, 2] = y0, y1, total
        total += y1 - y0
    spans = np.empty((total, 2), np.int32)  # first column of tiles, one past the last
    for lane in prange(lanes):
        for i in range(count * lane // lanes, count * (lane + 1) // lanes):
            for y in range(rows[i, 0], rows[i, 1]):
                x0, x1 = _tile_columns(reach[i], y, last)
                span = spans[rows[i, 2] + y - rows[i, 0]]
                span[0], span[1] = x0, x1
    heads = np.zeros(across * down + 1, np.int64)
    for lane in prange(lanes):  # a band of rows each
        first, past = down * lane // lanes, down * (lane + 1) // lanes
        for i in range(count):
            for y in range(max(rows[i, 0], first), min(rows[i, 1], past)):
                span = spans[rows[i, 2] + y - rows[i, 0]]
                for x in range(span[0], span[1]):
                    heads[y * across + x + 1] += 1
    for tile in range(across * down):
        heads[tile + 1] += heads[tile]
    starts, splats = heads.copy(), np.empty(heads[-1], np.int32)
    for lane in prange(lanes):
        first, past = down * lane // lanes, down * (lane + 1) // lanes
        for q in range(len(order)):
            i = order[q]
            for y in range(max(rows[i, 0], first), min(rows[i, 1], past)):
                span = spans[rows[i, 2] + y - rows[i, 0]]
                for x in range(span[0], span[1]):
                    splats[heads[y * across + x]] = i
                    heads[y * across + x] += 1
    return starts, splats


@kernel()
def _pixel_rows(d, u, v):
    """First and one past the last row of a tile that a splat reaches; u, v: the tile's first pixel less the centre."""
    low, high = _span(d[10], d[11], d[12], d[13], d[14], u, u + np.float32(TILE - 1))
    low, high = max(low - v, _ZERO), min(high - v, np.float32(TILE - 1))
    if not low <= high:
        return 0, 0
    return _ceil(low), np.int32(high) + 1


@kernel()
def _planes(count):
    """Zeros for `count` tiles, and where the first begins: at a cache line, for a row that straddles two costs double.

    One flat array and bounded row numbers let the compiler see that rows do not overlap, and keep sums in registers.
    """
    memory = np.zeros((count * TILE + 1) * TILE, np.float32)
    return memory, (-(memory.ctypes.data // 4)) & 15


@kernel()
def _live_rows(M, base):
    """First and one past the last row of a tile in which a pixel still takes splats."""
    first, past = TILE, 0
    for y in range(TILE):
        most = _ZERO
        for x in range(TILE):
            most = max(most, M[base + (y & 15) * TILE + x])
        if most > _MIN_T:
            first, past = min(first, y), y + 1
    return first, past


@kernel(parallel=True)
def blend_forward(starts, splats, drawing, background, lanes, image, alpha, depth, ends):
    """Fills image (H W 3), alpha (H W), depth (H W), and where each tile's list was left, ends (tiles).

    lanes: threads, over which neighbouring tiles are dealt out.
    """
    across, tiles = (alpha.shape[1] + TILE - 1) // TILE, len(ends)
    share = (tiles + lanes - 1) // lanes
    for job in prange(share * lanes):
        tile = (job % share) * lanes + job // share
        if tile < tiles:
            _blend_tile(tile, starts, splats, drawing, background, across, image, alpha, depth, ends)


@kernel(inline=False)
def _blend_tile(tile, starts, splats, drawing, background, across, image, alpha, depth, ends):
    height, width = alpha.shape
    x0, y0 = (tile % across) * TILE & _POSITIVE, (tile // across) * TILE & _POSITIVE
    h, w = min(TILE, height - y0), min(TILE, width - x0)
    M, base = _planes(7)
    for y in range(h):
        for x in range(w):
            M[base + y * TILE + x] = _ONE
    k, end = starts[tile], starts[tile + 1]
    top, bottom = 0, h
    while k < end:
        s = drawing[splats[k]]
        k += 1
        gx, gy, a = s[0] - np.float32(x0), s[1] - np.float32(y0), s[2]
        r, g, bl, z = s[6], s[7], s[8], s[9]
        b, c, peak = s[3], s[4], s[5]
        first, last = _pixel_rows(s, -gx, -gy)
        for y in range(max(first, top), min(last, bottom)):
            row = base + (y & 15) * TILE
            dy = gy - np.float32(np.int32(y))
            constant, linear = peak + c * dy * dy, b * dy
            for x in range(TILE):
                j = row + x
                dx = gx - np.float32(np.int32(x))
                al = fast_exp2(min(max(constant + dx * (linear + a * dx), _LOWEST), _HIGHEST))
                t = M[j]
                al = al if al >= _MIN_ALPHA else _ZERO
                al = al if t > _MIN_T else _ZERO
                wt = al * t
                M[j + _R] += wt * r
                M[j + _G] += wt * g
                M[j + _B] += wt * bl
                M[j + _D] += wt * z
                M[j] = t - wt
        if k % _CHECK == 0:
            top, bottom = _live_rows(M, base)
            if top >= bottom:
                break
    ends[tile] = k
    for y in range(h):
        for x in range(w):
            j = base + y * TILE + x
            t = M[j]
            image[y0 + y, x0 + x, 0] = M[j + _R] + t * background[0]
            image[y0 + y, x0 + x, 1] = M[j + _G] + t * background[1]
            image[y0 + y, x0 + x, 2] = M[j + _B] + t * background[2]
            alpha[y0 + y, x0 + x] = _ONE - t
            depth[y0 + y, x0 + x] = M[j + _D] / (_ONE - t) if t < _ONE else _ZERO


@kernel(parallel=True)
def blend_backward(starts, splats, drawing, ends, lanes, image, alpha, depth, g_image, g_alpha, g_depth, partials):
    """Fills partials (pairs 10) from the gradients of the image, alpha and depth; g_depth may be None."""
    across, tiles = (alpha.shape[1] + TILE - 1) // TILE, len(ends)
    share = (tiles + lanes - 1) // lanes
    for job in prange(share * lanes):
        tile = (job % share) * lanes + job // share
        if tile < tiles:
            _unblend_tile(tile, starts, splats, drawing, ends, across, image, alpha, depth, g_image, g_alpha, g_depth, partials)


@kernel(inline=False)
def _unblend_tile(tile, starts, splats, drawing, ends, across, image, alpha, depth, g_image, g_alpha, g_depth, partials):
    height, width = alpha.shape
    if starts[tile] == ends[tile]:
        return
    x0, y0 = (tile % across) * TILE & _POSITIVE, (tile // across) * TILE & _POSITIVE
    M, base = _planes(7)
    sums = base + _SUMS
    for y in range(min(TILE, height - y0)):
        for x in range(min(TILE, width - x0)):
            i, j, m = y0 + y, x0 + x, base + y * TILE + x
            M[m] = _ONE
            M[m + _R], M[m + _G], M[m + _B] = g_image[i, j, 0], g_image[i, j, 1], g_image[i, j, 2]
            rest = image[i, j, 0] * g_image[i, j, 0] + image[i, j, 1] * g_image[i, j, 1] + image[i, j, 2] * g_image[i, j, 2]
            rest -= (_ONE - alpha[i, j]) * g_alpha[i, j]
            if g_depth is not None and alpha[i, j] > 0:
                # depth = D / alpha: D is one more channel, and alpha gets -depth / alpha; the sum in S cancels but for T.
                M[m + _D] = g_depth[i, j] / alpha[i, j]
                rest += depth[i, j] * M[m + _D]
            M[m + _S] = rest
    top, bottom = 0, TILE
    for k in range(starts[tile], ends[tile]):
        if k % _CHECK == 0:
            top, bottom = _live_rows(M, base)
        s = drawing[splats[k]]
        gx, gy, a = s[0] - np.float32(x0), s[1] - np.float32(y0), s[2]
        r, g, bl, z = s[6], s[7], s[8], s[9]
        first, last = _pixel_rows(s, -gx, -gy)
        b, c, peak = s[3], s[4], s[5]
        for j in range(sums, sums + 7 * TILE):
            M[j] = _ZERO
        for y in range(max(first, top), min(last, bottom)):
            row = base + (y & 15) * TILE
            dy = gy - np.float32(np.int32(y))
            constant, linear = peak + c * dy * dy, b * dy
            for x in range(TILE):
                j, q = row + x, sums + x
                dx = gx - np.float32(np.int32(x))
                power = max(constant + dx * (linear + a * dx), _LOWEST)
                al = fast_exp2(min(power, _HIGHEST))
                t = M[j]
                al = al if al >= _MIN_ALPHA else _ZERO
                al = al if t > _MIN_T else _ZERO
                wt = al * t
                colour = r * M[j + _R] + g * M[j + _G] + bl * M[j + _B]
                if g_depth is not None:
                    colour += z * M[j + _D]
                rest = M[j + _S] - wt * colour
                M[j + _S] = rest
                M[j] = t - wt
                # Gradient of the exponent; none where alpha is held at its largest.
                gs = al * (rest / (_ONE - al) - t * colour)
                gs = gs if power < _HIGHEST else _ZERO
                M[q] += gs
                M[q + 16] += gs * dy
                M[q + 32] += gs * dy * dy
                M[q + 48] += wt * M[j + _R]
                M[q + 64] += wt * M[j + _G]
                M[q + 80] += wt * M[j + _B]
                if g_depth is not None:
                    M[q + 96] += wt * M[j + _D]
        _write_partials(M, sums, gx, partials[k])


@kernel()
def _write_partials(M, sums, gx, out):
    """From sums over a tile's columns to moments of one splat; dx and its square are the same down a column."""
    lane_moments(M, sums, out)  # pyright: ignore[reportCallIssue]
    middle = gx - np.float32((TILE - 1) / 2)
    g0, gx1, gy1 = out[0], out[1], out[2]
    out[1] = middle * g0 - gx1
    out[3] += middle * (middle * g0 - _TWO * gx1)
    out[4] = middle * gy1 - out[4]


@kernel(parallel=True)
def sum_partials(starts, ends, splats, partials, conic, opacity, lanes):
    """Gradients of xy (N 2), conic (N 3), opacity (N), rgb (N 3), depth (N), summed tile after tile: always in one order.

    lanes: threads, each of which sums for splats of its own.
    """
    n = len(conic)
    totals = np.zeros((n, PARTIALS), np.float32)
    g_xy, g_conic, g_opacity = np.empty((n, 2), np.float32), np.empty((n, 3), np.float32), np.empty(n, np.float32)
    g_rgb, g_depth = np.empty((n, 3), np.float32), np.empty(n, np.float32)
    for lane in prange(lanes):
        first, past = n * lane // lanes, n * (lane + 1) // lanes
        for tile in range(len(ends)):
            for k in range(starts[tile], ends[tile]):
                i = splats[k]
                if first <= i < past:
                    for j in range(PARTIALS):
                        totals[i, j] += partials[k, j]
        for i in range(first, past):
            t = totals[i]
            g_opacity[i] = -t[0] / max(opacity[i], _TINY)
            g_xy[i, 0], g_xy[i, 1] = conic[i, 0] * t[1] + conic[i, 1] * t[2], conic[i, 1] * t[1] + conic[i, 2] * t[2]
            g_conic[i, 0], g_conic[i, 1], g_conic[i, 2] = _HALF * t[3], t[4], _HALF * t[5]
            g_rgb[i, 0], g_rgb[i, 1], g_rgb[i, 2], g_depth[i] = t[6], t[7], t[8], t[9]
    return g_xy, g_conic, g_opacity, g_rgb, g_depth
