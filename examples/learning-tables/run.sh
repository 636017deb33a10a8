#!/usr/bin/env bash
# The tables of docs/learning-tables.md: three groups of simulated sensors, from presses to a report.
#
#   [PYTHON=.venv/bin/python] [DEVICE=cuda:0] [PROCESSES=16] [JOBS=8] \
#     bash examples/learning-tables/run.sh OUT [GROUP...]
#
# Presses are simulated on PROCESSES cores, JOBS models are trained side by side on DEVICE. Stopped
# at any moment, the same command goes on.
set -euo pipefail
out=${1:?where to, for instance runs/tables}
shift
[ $# -gt 0 ] || set -- homogeneous material heterogeneous
python=${PYTHON:-python} processes=${PROCESSES:-$(nproc)}
export OMP_NUM_THREADS=2

for group in "$@"; do
  labels='[compensated]'
  case $group in
    homogeneous) scale=0.1 labels='[]' ;; # one skin: nothing to compensate
    material) scale=0.5 ;;
    heterogeneous) scale=0.15 labels='[compensated, oracle]' ;;
    *) echo "GROUP: found '$group'; allowed: homogeneous, material, heterogeneous" >&2; exit 2 ;;
  esac
  "$python" -m sim archive sensors --group "$group" --tier layer --scale "$scale" --steps 4 \
    --no-check --processes "$processes" --out "$out/$group.markers.zarr"
  "$python" -m learning experiment "$out/$group.markers.zarr" --out "$out/$group" --preset tables \
    --device "${DEVICE:-cpu}" --processes "$processes" --jobs "${JOBS:-1}" --set "compensation=$labels"
done
