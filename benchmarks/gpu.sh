#!/bin/sh
# Builds the CUDA back end, tests it against the reference, and measures it.
#
#     benchmarks/gpu.sh OUT [CAPTURE...]
#
# Needs an NVIDIA GPU, nvcc, and a python (PYTHON, else the one of .venv, else python3) with torch for CUDA, gsplat 1.5.3
# and the package's other dependencies.  Writes to OUT: the tests' output, the figures of speed.py, and for captures the
# runs and tables of the presets "paper" and "default".
set -eu
cd "$(dirname "$0")/.."
[ $# -ge 1 ] || { echo "usage: benchmarks/gpu.sh OUT [CAPTURE...]" >&2; exit 2; }
out=$1
shift
[ -n "${PYTHON:-}" ] || { [ -x .venv/bin/python ] && PYTHON=.venv/bin/python || PYTHON=python3; }
"$PYTHON" -c 'import sys, torch; sys.exit(0 if torch.cuda.is_available() else "gpu.sh: torch sees no NVIDIA GPU here.")' || exit 2
"$PYTHON" -c 'import gsplat' 2>/dev/null || { echo "gpu.sh: gsplat is not installed; run: pip install 'structuregs[gpu]'." >&2; exit 2; }
mkdir -p "$out"

# gsplat compiles its kernels at its first use: for this GPU only, on all cores, with the headers of torch's own CUDA.
if [ -z "${CUDA_HOME:-}" ]; then
    nvcc=$(command -v nvcc) || { echo "gpu.sh: nvcc is not on the PATH; install the CUDA toolkit or set CUDA_HOME." >&2; exit 2; }
    CUDA_HOME=$(dirname "$(dirname "$(readlink -f "$nvcc")")")
fi
TORCH_CUDA_ARCH_LIST=${TORCH_CUDA_ARCH_LIST:-$("$PYTHON" -c 'import torch; print("%d.%d" % torch.cuda.get_device_capability())')}
MAX_JOBS=${MAX_JOBS:-$(nproc)}
for headers in $("$PYTHON" -c 'import glob, site; print(*[p for s in site.getsitepackages() for p in glob.glob(s + "/nvidia/cu*/include")])'); do
    CPATH=$headers${CPATH:+:$CPATH}
done
export CUDA_HOME TORCH_CUDA_ARCH_LIST MAX_JOBS CPATH="${CPATH:-}" PYTHONPATH="src${PYTHONPATH:+:$PYTHONPATH}"

"$PYTHON" -m pytest -q tests/test_raster_cuda.py 2>&1 | tee "$out/tests.txt"
grep -q passed "$out/tests.txt" && ! grep -q failed "$out/tests.txt" || exit 1
"$PYTHON" benchmarks/speed.py --sections growth --device cuda --json "$out/cuda.json" | tee "$out/speed.txt"
[ $# -eq 0 ] || for preset in paper default; do
    "$PYTHON" -c 'from structuregs.cli import main; main()' bench "$@" -o "$out/$preset" --preset $preset --seeds 0 --device cuda
done
