"""What this machine can do at most: multiply-adds and bytes per second, measured in the run that they are held against."""

import time

import numpy as np
from numba import get_num_threads, njit, prange

_CHAINS = 16  # vectors in flight: enough to hide the latency of a multiply-add on both units
_LANES = 16
_ROUNDS = 400_000


@njit(parallel=True, fastmath=True, error_model="numpy")
def _multiply_add(threads, rounds, factor, out):
    for thread in prange(threads):
        a = np.full(_CHAINS * _LANES, np.float32(thread))
        for _ in range(rounds):
            for i in range(_CHAINS * _LANES):
                a[i] = a[i] * factor + np.float32(0.5)
        out[thread] = a.sum()


@njit(parallel=True)
def _copy(source, target, threads):
    n = len(source) // threads
    for thread in prange(threads):
        for i in range(thread * n, (thread + 1) * n):
            target[i] = source[i]


def _best(function, repeats: int = 7) -> float:
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def peaks() -> tuple[float, float]:
    """Billions of float32 operations (two for a multiply-add) and gigabytes copied (read and written) per second."""
    threads = get_num_threads()
    out = np.empty(threads, np.float32)
    seconds = _best(lambda: _multiply_add(threads, _ROUNDS, np.float32(0.999), out))
    operations = 2 * _CHAINS * _LANES * _ROUNDS * threads / seconds
    source = np.zeros(32 << 20, np.float32)
    target = np.empty_like(source)
    moved = 2 * source.nbytes / _best(lambda: _copy(source, target, threads))
    return operations / 1e9, moved / 1e9
