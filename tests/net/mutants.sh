#!/usr/bin/env bash
# Count the mutants of some modules that their tests catch: cosmic-ray, in a copy of the checkout.
#   tests/net/mutants.sh COUNT "rig/core/guard.py rig/core/stand_in_guards.py" "tests/rig/test_guard.py tests/rig/test_no_gauge.py"
#   tests/net/mutants.sh COUNT recorder/session/align.py tests/recorder/test_align.py
# Needs `pip install cosmic-ray` beside the checkout's own packages. The sample is the same each time.
set -euo pipefail
count=$1 modules=$2 tests=$3 python=${PYTHON:-python} copy=$(mktemp -d)
git archive HEAD | tar -x -C "$copy"
cd "$copy"
list=$(printf '"%s",' $modules)
cat > cosmic-ray.toml <<T
[cosmic-ray]
module-path = [${list%,}]
timeout = 60.0
excluded-modules = []
test-command = "env PYTHONPATH=$copy $python -m pytest -q -x -n 0 -p no:cacheprovider $tests"
[cosmic-ray.distributor]
name = "local"
T
cosmic-ray init cosmic-ray.toml mutants.sqlite
"$python" - "$count" <<'P'
import random
import sqlite3
import sys

base = sqlite3.connect("mutants.sqlite")
rows = base.execute(
    "select job_id, module_path, operator_name, occurrence, start_pos_row from mutation_specs"
).fetchall()
rows.sort(key=lambda row: row[1:])
kept = {row[0] for row in random.Random(57).sample(rows, min(int(sys.argv[1]), len(rows)))}
for row in rows:
    if row[0] not in kept:
        base.execute("delete from mutation_specs where job_id=?", row[:1])
        base.execute("delete from work_items where job_id=?", row[:1])
base.commit()
P
cosmic-ray exec cosmic-ray.toml mutants.sqlite
cr-report mutants.sqlite | tail -3
echo "in $copy"
