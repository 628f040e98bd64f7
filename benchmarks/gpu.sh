#!/usr/bin/env bash
# gpu.sh OUT [STEP ...]: measure on this machine's GPU, in at most 9 minutes, or a small instance on the CPU.
#
# Python has what pyproject.toml lists, and for comparison torch and gsplat. A machine without a network unpacks them
# from .whl/site.tar.xz, which has site-packages for its Python. gsplat compiles its kernels meanwhile.
set -euo pipefail
cd "$(dirname "$0")/.."
out=$1; shift
mkdir -p "$out"
python=${PYTHON:-python3}
export PYTHONUNBUFFERED=1 PYTHONPATH=$PWD GSPLAT_READY=${TMPDIR:-/tmp}/gsplat_ready
if [ -f .whl/site.tar.xz ]; then
  site=${TMPDIR:-/tmp}/site
  [ -d "$site" ] || { mkdir -p "$site" && tar -xJf .whl/site.tar.xz -C "$site"; }
  export PYTHONPATH=$PWD:$site
fi
if nvidia-smi > /dev/null 2>&1; then
  options=(--variant cuda_ad_rgb)
  export TORCH_CUDA_ARCH_LIST=${TORCH_CUDA_ARCH_LIST:-9.0} MAX_JOBS=${MAX_JOBS:-$(nproc)}
  if [ ! -f "$GSPLAT_READY" ]; then
    (cd / && "$python" -c "from gsplat.cuda._backend import _C; assert _C" && touch "$GSPLAT_READY") \
      > "$out/gsplat.log" 2>&1 &
  fi
else
  options=(--small)
fi
exec timeout 530 "$python" -m benchmarks.gpu "${options[@]}" "$out" "$@"
