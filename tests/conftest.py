"""How the suite shares the machine: workers beside each other compute with one thread each."""

import os

if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ["NUMBA_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"  # before Numba and torch are loaded
