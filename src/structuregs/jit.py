"""How Numba kernels are compiled and launched."""

import inspect
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import joblib
import numpy as np
from numba import get_num_threads, njit, set_num_threads
from numba.core import event

# Not the freedom to assume that there is no NaN or infinity: the guards against those must stay.  Nor that to add up in
# another order or to divide by multiplying: a process that has just compiled a kernel runs another copy of its loops than
# one that loads it from the cache, and the two would make use of it differently.
_FASTMATH = {"nsz", "contract", "afn"}

# Numba's fallback threading layer ends the process when two Python threads launch parallel kernels at once.
_LAUNCH = threading.Lock()


def kernel(*, parallel: bool = False, inline: bool = True) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """A decorator that compiles a function with Numba, cached on disk.

    Kernels carry no annotations: their docstrings give shapes.  The test suite's shape checker wraps every function of
    the package; the wrapper is taken off here.

    Args:
        parallel: has loops over `prange`; launch it with `lanes`.
        inline: make it a part of every kernel that calls it.  A process that has just compiled a helper for itself would
            otherwise call that, one that loads its caller from the cache the caller's own copy, and the two round
            differently.  To be turned off for what is large and hot, where the compiler does better with a function by
            itself, and only for what calls nothing that is not inlined.
    """

    def compile_function(function: Callable[..., Any]) -> Callable[..., Any]:
        options = {"boundscheck": False, "error_model": "numpy", "cache": True, "fastmath": _FASTMATH}
        return njit(inspect.unwrap(function), parallel=parallel, forceinline=inline and not parallel, **options)

    return compile_function


@cache
def _processors() -> int:
    return joblib.cpu_count()  # less than the machine has where a container grants less


@contextmanager
def lanes() -> Iterator[int]:
    """Wraps the launch of parallel kernels; gives the number of threads: Numba's, but no more than processors are granted."""
    with _LAUNCH:
        before = get_num_threads()
        count = min(before, _processors())
        set_num_threads(count)
        try:
            yield count
        finally:
            set_num_threads(before)


class _FirstStart(event.Listener):
    """Calls a function once, at the first event's start."""

    def __init__(self, say: Callable[[], object]):
        self.say: Callable[[], object] | None = say

    def on_start(self, event: event.Event) -> None:  # noqa: ARG002
        say, self.say = self.say, None
        if say is not None:
            say()

    def on_end(self, event: event.Event) -> None:
        pass


@contextmanager
def when_compiling(say: Callable[[], object]) -> Iterator[None]:
    """Within, `say` is called once if a kernel is not in the cache and has to be compiled."""
    with event.install_listener("numba:compile", _FirstStart(say)):
        yield


@kernel()
def fast_exp2(x):
    """2^x for -126 < x < 127 in float32, relative error 3e-7: a polynomial, which vectorises where `math.exp` does not."""
    whole = np.floor(x)
    f = x - whole
    p = np.float32(1.8775767e-3)
    p = p * f + np.float32(8.9893397e-3)
    p = p * f + np.float32(5.5826318e-2)
    p = p * f + np.float32(2.4015361e-1)
    p = p * f + np.float32(6.9315308e-1)
    p = p * f + np.float32(9.9999994e-1)
    # 2^whole goes straight into the exponent's bits.
    return np.int32(np.float32(p).view(np.int32) + (np.int32(whole) << np.int32(23))).view(np.float32)
