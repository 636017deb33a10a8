#!/usr/bin/env bash
# Limits of the transfer of the heterogeneous table: one change at a time, for two pairs.
#
#   [PYTHON=.venv/bin/python] [DEVICE=cuda:0] [PROCESSES=16] [JOBS=8] [SCALE=0.15] [PRESET=NAME] \
#     [PAIRS=uskin:gelsight,gelsight:tacpalm] [ONLY=experiment] \
#     bash benchmarks/learning/tables/ablations.sh OUT [NAME...]
#
# OUT is the folder of run.sh with its heterogeneous table, whose translators are reused. Names:
# whole: unchanged; half, quarter: of the presses that force models are trained on; single-frame: each
# frame without its predecessors; clean: sensors without segmentation errors, with newly trained translators.
# ONLY=experiment: write no page at the end.
set -euo pipefail
out=${1:?where the heterogeneous table is, for instance runs/tables}
shift
[ $# -gt 0 ] || set -- whole half quarter single-frame clean
python=${PYTHON:-python} processes=${PROCESSES:-$(nproc)} device=${DEVICE:-cpu} base=$out/heterogeneous
export OMP_NUM_THREADS=2
made=()

share() { # FRACTION: that share of the table's presses to train on
  "$python" -c "
import json, sys
presses = json.load(open(sys.argv[1]))['presses']['train'].values()
print(sum(map(len, presses)) // int(sys.argv[2]))
" "$base/split.json" "$1"
}

for name in "$@"; do
  [ "$name" = clean ] || [ -f "$base/split.json" ] || { echo "OUT: no table in $base; run.sh makes it" >&2; exit 2; }
  archive=$base.markers.zarr translators='[field]' changed=()
  case $name in
    whole) ;;
    half) changed=(--set "train_presses=$(share 2)") ;;
    quarter) changed=(--set "train_presses=$(share 4)") ;;
    single-frame) changed=(--set memory=false) ;;
    clean) archive=$base-clean.markers.zarr ;;
    *) echo "NAME: found '$name'; allowed: whole, half, quarter, single-frame, clean" >&2; exit 2 ;;
  esac
  mkdir -p "$out/ablations/$name/models"
  if [ "$name" = clean ]; then
    ONLY=archive bash "$(dirname "$0")/run.sh" "$out" heterogeneous-clean
  else
    [ -d "$out/ablations/$name/models/field" ] || [ ! -d "$base/models/field" ] ||
      cp -r "$base/models/field" "$out/ablations/$name/models/"
  fi
  "$python" -m tactile experiment "$archive" --out "$out/ablations/$name" --preset "${PRESET:-tables-heterogeneous}" \
    --pairs "${PAIRS:-uskin:gelsight,gelsight:tacpalm}" --device "$device" --processes "$processes" \
    --jobs "${JOBS:-1}" --set "compensation=[priors]" --set "translators=$translators" "${changed[@]}"
  made+=("$out/ablations/$name")
done
[ "${ONLY:-}" = experiment ] || "$python" -m benchmarks learning-tables "${made[@]}" --out "$out/learning-ablations.md" \
  --intro "$(dirname "$0")/ablations.md"
