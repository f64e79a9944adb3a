"""How the suite shares the machine: beside each other, workers draw with one thread each."""

import os

import numba

if "PYTEST_XDIST_WORKER" in os.environ:
    numba.set_num_threads(1)  # of as many as there are: tests of several threads still ask for them
