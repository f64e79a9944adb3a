"""The blend of 2D Gaussians in Numba: tile lists, image, gradients.

The image is cut into tiles of 16 x 16 pixels; a row of a tile is one vector.  The backward pass runs from near to far
as the forward pass does: what lies behind a splat is the final colour less all that came before, so nothing but the
final image is kept.  Every (tile, splat) pair has its own row of partial gradients, summed over the pairs of a splat in a
fixed order: no atomics, and the same bytes for any number of threads.
"""

import math

import numpy as np
from numba import prange

from .jit import fast_exp, kernel
from .records import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE

TILE = 16
ROW = 16  # values in a splat's row of `pack`: one cache line
PARTIALS = 10  # values in a pair's row of partial gradients: xy (2), conic (3), opacity, rgb (3), depth
_MAX_ALPHA, _MIN_ALPHA, _MIN_T = np.float32(MAX_ALPHA), np.float32(MIN_ALPHA), np.float32(MIN_TRANSMITTANCE)
_ZERO, _ONE, _TWO, _HALF = np.float32(0), np.float32(1), np.float32(2), np.float32(0.5)
_SLACK = np.float32(1e-2)  # pixels; spans are rounded outwards, each pixel's own alpha decides
_CHECK = 16  # splats between two looks at whether a tile is full


@kernel()
def pack(xy, conic, opacity, rgb, depth, extent, rows):
    """Fills rows (N 16): centre (with pixel centres at integers), conic, opacity, rgb, depth, extent, ln-limit, unused."""
    for i in range(len(xy)):
        rows[i, 0], rows[i, 1] = xy[i, 0] - _HALF, xy[i, 1] - _HALF
        rows[i, 2], rows[i, 3], rows[i, 4] = conic[i, 0], conic[i, 1], conic[i, 2]
        rows[i, 5] = opacity[i]
        rows[i, 6], rows[i, 7], rows[i, 8] = rgb[i, 0], rgb[i, 1], rgb[i, 2]
        rows[i, 9] = depth[i]
        rows[i, 10], rows[i, 11] = extent[i, 0], extent[i, 1]
        rows[i, 12] = _TWO * np.float32(math.log(max(opacity[i] / _MIN_ALPHA, _ONE)))


@kernel()
def _span(p, q, r, limit, eu, ev, low, high):
    """Range of v in the part of the ellipse p u^2 + 2 q u v + r v^2 <= limit with low <= u <= high; empty as (1, 0).

    eu, ev: the ellipse's half sizes, which stay exact for thin ellipses where p r - q^2 cancels.
    """
    low, high = max(low, -eu), min(high, eu)
    if low > high:
        return _ONE, _ZERO
    turn = -q / p * ev  # u where v is largest
    a, b = min(max(turn, low), high), min(max(-turn, low), high)
    top = math.sqrt(limit * r * max(_ONE - (a / eu) * (a / eu), _ZERO))
    bottom = math.sqrt(limit * r * max(_ONE - (b / eu) * (b / eu), _ZERO))
    return np.float32((-q * b - bottom) / r - _SLACK), np.float32((-q * a + top) / r + _SLACK)


@kernel()
def _tile_rows(s, height):
    """First and one past the last row of tiles that a splat's row reaches."""
    low = max(math.floor(max(s[1] - s[11], _ZERO)) // TILE, 0)
    high = min(s[1] + s[11], np.float32(height - 1))
    return int(low), int(math.floor(high) // TILE) + 1 if high >= 0 else 0


@kernel()
def _tile_columns(s, row, width):
    """First and one past the last tile that a splat's row reaches in a row of tiles."""
    v = np.float32(row * TILE) - s[1]
    left, right = _span(s[4], s[3], s[2], s[12], s[11], s[10], v - _SLACK, v + np.float32(TILE - 1) + _SLACK)
    left, right = max(s[0] + left, _ZERO), min(s[0] + right, np.float32(width - 1))
    if left > right:
        return 0, 0
    # Pixels are at integers: a tile whose last pixel lies left of the span is not reached.
    return int(math.ceil(left)) // TILE, int(math.floor(right)) // TILE + 1


@kernel()
def tile_lists(rows, order, width, height):
    """Which splats each tile draws, from near to far.

    Args:
        rows: see `pack`.
        order: the drawn splats by depth.
        width, height: of the image, pixels.

    Returns:
        starts: where each tile's list begins in `splats`, and the total (tiles + 1).
        splats: the lists.
        pair_starts: where each splat's pairs begin in `pairs`, and the total (N + 1).
        pairs: positions in `splats`.
    """
    across, down = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    starts = np.zeros(across * down + 1, np.int64)
    pair_starts = np.zeros(len(rows) + 1, np.int64)
    for q in range(len(order)):
        s = rows[order[q]]
        y0, y1 = _tile_rows(s, height)
        for y in range(y0, y1):
            x0, x1 = _tile_columns(s, y, width)
            for x in range(x0, x1):
                starts[y * across + x + 1] += 1
            pair_starts[order[q] + 1] += max(x1 - x0, 0)
    for t in range(across * down):
        starts[t + 1] += starts[t]
    for i in range(len(rows)):
        pair_starts[i + 1] += pair_starts[i]
    splats, pairs = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.int32)
    heads = starts[:-1].copy()
    for q in range(len(order)):
        i = order[q]
        pair = pair_starts[i]
        s = rows[i]
        y0, y1 = _tile_rows(s, height)
        for y in range(y0, y1):
            x0, x1 = _tile_columns(s, y, width)
            for x in range(x0, x1):
                k = heads[y * across + x]
                heads[y * across + x] = k + 1
                splats[k] = i
                pairs[pair] = k
                pair += 1
    return starts, splats, pair_starts, pairs


@kernel()
def _pixel_rows(s, x0, y0):
    """First and one past the last row of a tile that a splat reaches."""
    u = np.float32(x0) - s[0]
    low, high = _span(s[2], s[3], s[4], s[12], s[10], s[11], u - _SLACK, u + np.float32(TILE - 1) + _SLACK)
    base = s[1] - np.float32(y0)
    low, high = max(base + low, _ZERO), min(base + high, np.float32(TILE - 1))
    if not low <= high:
        return 0, 0
    return int(math.ceil(low)), int(math.floor(high)) + 1


@kernel(parallel=True)
def blend_forward(starts, splats, rows, background, lanes, image, alpha, depth, ends):
    """Fills image (H W 3), alpha (H W), depth (H W), and where each tile's list was left, ends (tiles).

    lanes: threads, over which neighbouring tiles are dealt out.
    """
    height, width = alpha.shape
    across, tiles = (width + TILE - 1) // TILE, len(ends)
    share = (tiles + lanes - 1) // lanes
    for job in prange(share * lanes):
        tile = (job % share) * lanes + job // share
        if tile < tiles:
            _blend_tile(tile, starts, splats, rows, background, across, image, alpha, depth, ends)


@kernel()
def _blend_tile(tile, starts, splats, rows, background, across, image, alpha, depth, ends):
    height, width = alpha.shape
    x0, y0 = (tile % across) * TILE, (tile // across) * TILE
    h, w = min(TILE, height - y0), min(TILE, width - x0)
    state = np.zeros((5, TILE, TILE), np.float32)
    T, R, G, B, D = state[0], state[1], state[2], state[3], state[4]
    T[:h, :w] = _ONE
    k, end = starts[tile], starts[tile + 1]
    while k < end:
        s = rows[splats[k]]
        k += 1
        gx, gy, a, b, c, o = s[0] - np.float32(x0), s[1] - np.float32(y0), s[2], s[3], s[4], s[5]
        r, g, bl, z = s[6], s[7], s[8], s[9]
        first, last = _pixel_rows(s, x0, y0)
        for y in range(first, last):
            dy = gy - np.float32(y)
            s0, s1 = -_HALF * c * dy * dy, -b * dy
            for x in range(TILE):
                dx = gx - np.float32(np.int32(x))
                al = min(o * fast_exp(min(s0 + dx * (s1 - _HALF * a * dx), _ZERO)), _MAX_ALPHA)
                t = T[y, x]
                al = al if al >= _MIN_ALPHA else _ZERO
                al = al if t > _MIN_T else _ZERO
                wt = al * t
                R[y, x] += wt * r
                G[y, x] += wt * g
                B[y, x] += wt * bl
                D[y, x] += wt * z
                T[y, x] = t - wt
        if k % _CHECK == 0:
            most = _ZERO
            for y in range(TILE):
                for x in range(TILE):
                    most = max(most, T[y, x])
            if most <= _MIN_T:
                break
    ends[tile] = k
    for y in range(h):
        for x in range(w):
            t = T[y, x]
            image[y0 + y, x0 + x, 0] = R[y, x] + t * background[0]
            image[y0 + y, x0 + x, 1] = G[y, x] + t * background[1]
            image[y0 + y, x0 + x, 2] = B[y, x] + t * background[2]
            alpha[y0 + y, x0 + x] = _ONE - t
            depth[y0 + y, x0 + x] = D[y, x] / (_ONE - t) if t < _ONE else _ZERO


@kernel(parallel=True)
def blend_backward(starts, splats, rows, ends, lanes, image, alpha, depth, g_image, g_alpha, g_depth, partials):
    """Fills partials (pairs 10) from the gradients of the image, alpha and depth; g_depth may be None."""
    height, width = alpha.shape
    across, tiles = (width + TILE - 1) // TILE, len(ends)
    share = (tiles + lanes - 1) // lanes
    for job in prange(share * lanes):
        tile = (job % share) * lanes + job // share
        if tile < tiles:
            _unblend_tile(tile, starts, splats, rows, ends, across, image, alpha, depth, g_image, g_alpha, g_depth, partials)


@kernel()
def _unblend_tile(tile, starts, splats, rows, ends, across, image, alpha, depth, g_image, g_alpha, g_depth, partials):
    height, width = alpha.shape
    x0, y0 = (tile % across) * TILE, (tile // across) * TILE
    h, w = min(TILE, height - y0), min(TILE, width - x0)
    state = np.zeros((6, TILE, TILE), np.float32)
    # T: let through so far; S: gradient-weighted colour (less alpha) that is still to come, from here to the background.
    T, S, GR, GG, GB, GD = state[0], state[1], state[2], state[3], state[4], state[5]
    sums = np.zeros((7, TILE), np.float32)
    for y in range(h):
        for x in range(w):
            T[y, x] = _ONE
            i, j = y0 + y, x0 + x
            GR[y, x], GG[y, x], GB[y, x] = g_image[i, j, 0], g_image[i, j, 1], g_image[i, j, 2]
            rest = image[i, j, 0] * GR[y, x] + image[i, j, 1] * GG[y, x] + image[i, j, 2] * GB[y, x]
            S[y, x] = rest - (_ONE - alpha[i, j]) * g_alpha[i, j]
            if g_depth is not None and alpha[i, j] > 0:
                # depth = D / alpha: D is one more channel, and alpha gets -depth / alpha; the sum in S cancels but for T.
                GD[y, x] = g_depth[i, j] / alpha[i, j]
                S[y, x] += depth[i, j] * GD[y, x]
    for k in range(starts[tile], ends[tile]):
        s = rows[splats[k]]
        gx, gy, a, b, c, o = s[0] - np.float32(x0), s[1] - np.float32(y0), s[2], s[3], s[4], s[5]
        r, g, bl, z = s[6], s[7], s[8], s[9]
        first, last = _pixel_rows(s, x0, y0)
        sums[:] = _ZERO
        for y in range(first, last):
            dy = gy - np.float32(y)
            s0, s1 = -_HALF * c * dy * dy, -b * dy
            for x in range(TILE):
                dx = gx - np.float32(np.int32(x))
                raw = o * fast_exp(min(s0 + dx * (s1 - _HALF * a * dx), _ZERO))
                al = min(raw, _MAX_ALPHA)
                t = T[y, x]
                al = al if al >= _MIN_ALPHA else _ZERO
                al = al if t > _MIN_T else _ZERO
                wt = al * t
                colour = r * GR[y, x] + g * GG[y, x] + bl * GB[y, x]
                if g_depth is not None:
                    colour += z * GD[y, x]
                rest = S[y, x] - wt * colour
                S[y, x] = rest
                T[y, x] = t - wt
                # Gradient of the exponent; none where alpha is held at its largest.
                gs = al * (rest / (_ONE - al) - t * colour)
                gs = gs if raw < _MAX_ALPHA else _ZERO
                sums[0, x] += gs
                sums[1, x] += gs * dy
                sums[2, x] += gs * dy * dy
                sums[3, x] += wt * GR[y, x]
                sums[4, x] += wt * GG[y, x]
                sums[5, x] += wt * GB[y, x]
                if g_depth is not None:
                    sums[6, x] += wt * GD[y, x]
        _write_partials(sums, gx, a, b, c, o, partials[k])
    partials[ends[tile] : starts[tile + 1]] = _ZERO


@kernel()
def _write_partials(sums, gx, a, b, c, o, out):
    """From sums over a tile's columns to the gradients of one splat; dx and its square are taken per column."""
    g0, gu, gv, guu, guv, gvv = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    red, green, blue, z = _ZERO, _ZERO, _ZERO, _ZERO
    for x in range(TILE):
        dx = gx - np.float32(np.int32(x))
        g0 += sums[0, x]
        gu += sums[0, x] * dx
        guu += sums[0, x] * dx * dx
        gv += sums[1, x]
        guv += sums[1, x] * dx
        gvv += sums[2, x]
        red += sums[3, x]
        green += sums[4, x]
        blue += sums[5, x]
        z += sums[6, x]
    out[0], out[1] = a * gu + b * gv, b * gu + c * gv
    out[2], out[3], out[4] = _HALF * guu, guv, _HALF * gvv
    out[5] = -g0 / o
    out[6], out[7], out[8], out[9] = red, green, blue, z


@kernel(parallel=True)
def sum_partials(pair_starts, pairs, partials, totals):
    """Fills totals (N 10) with each splat's sum over its pairs, always in the same order."""
    for i in prange(len(totals)):
        for j in range(PARTIALS):
            totals[i, j] = _ZERO
        for p in range(pair_starts[i], pair_starts[i + 1]):
            for j in range(PARTIALS):
                totals[i, j] += partials[pairs[p], j]
