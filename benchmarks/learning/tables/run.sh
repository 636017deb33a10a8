#!/usr/bin/env bash
# The tables of docs/results/learning-tables.md: groups of simulated sensors, from presses to a report.
#
#   [PYTHON=.venv/bin/python] [DEVICE=cuda:0] [PROCESSES=16] [JOBS=8] [ONLY=archive|experiment] [SCALE=0.02] \
#     [PRESET=NAME] bash benchmarks/learning/tables/run.sh OUT [TABLE...]
#
# Tables: homogeneous, material, heterogeneous: all pairs on a sample of each group;
# homogeneous-full, material-full, heterogeneous-full: one pair of each with all its targets;
# heterogeneous-clean: sensors without segmentation errors, for ablations.sh.
# ONLY=archive: make the archives only; ONLY=experiment: write no page at the end.
# Presses are simulated on PROCESSES cores; images are made, and JOBS models in parallel trained, on
# DEVICE. After a stop, the same command continues.
set -euo pipefail
out=${1:?where to, for instance runs/tables}
shift
[ $# -gt 0 ] || set -- homogeneous material heterogeneous
python=${PYTHON:-python} processes=${PROCESSES:-$(nproc)}
made=() clean=$(dirname "$0")/clean
export OMP_NUM_THREADS=2

for table in "$@"; do
  steps=4 pairs=() preset=tables labels='[compensated, priors]' translators='[field, flow]'
  case $table in
    homogeneous) sensors=(homogeneous) scale=0.1 labels='[]' ;; # one skin
    material) sensors=(material) scale=0.25 ;;
    heterogeneous) sensors=(heterogeneous) scale=0.15 labels='[compensated, priors, oracle]' ;;
    homogeneous-full) sensors=(array-i,circle-ii) pairs=(--pairs array-i:circle-ii) labels='[]' ;;
    material-full) sensors=(r6,r18) pairs=(--pairs r6:r18) ;;
    heterogeneous-clean) sensors=("$clean/uskin.yaml,$clean/gelsight.yaml,$clean/tacpalm.yaml") scale=0.15 ;;
    heterogeneous-full) sensors=(uskin,gelsight) pairs=(--pairs uskin:gelsight) ;;
    *) echo "TABLE: found '$table'; allowed: a group, a group and -full, or heterogeneous-clean" >&2; exit 2 ;;
  esac
  case $table in heterogeneous*) preset=tables-heterogeneous ;; esac
  case $table in *-full) preset=tables-full scale=full steps=2 translators='[field, flow]' ;; esac
  "$python" -m tactile sim archive "${sensors[@]}" --tier layer --scale "${SCALE:-$scale}" --steps "$steps" \
    --no-check --device "${DEVICE:-cpu}" --processes "$processes" --out "$out/$table.markers.zarr"
  [ "${ONLY:-}" != archive ] || continue
  "$python" -m tactile experiment "$out/$table.markers.zarr" --out "$out/$table" --preset "${PRESET:-$preset}" \
    "${pairs[@]}" --device "${DEVICE:-cpu}" --processes "$processes" --jobs "${JOBS:-1}" \
    --set "compensation=$labels" --set "translators=$translators"
  made+=("$out/$table")
done
[ ${#made[@]} -eq 0 ] || [ "${ONLY:-}" = experiment ] || "$python" -m benchmarks learning-tables "${made[@]}" --out "$out/learning-tables.md" \
  --intro "$(dirname "$0")/tables.md"
