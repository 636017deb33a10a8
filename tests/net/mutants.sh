#!/usr/bin/env bash
# Count the mutants of some modules that their tests catch: cosmic-ray, in copies of the checkout.
#   tests/net/mutants.sh COUNT MODULES TESTS, where TESTS are pytest's arguments. In seconds a mutant:
#   mutants.sh 100 "rig/core/guard.py rig/core/stand_in_guards.py" "tests/rig/test_guard.py tests/rig/test_no_gauge.py"
#   mutants.sh 100 recorder/session/align.py tests/recorder/test_align.py
#   mutants.sh 200 "recorder/store/shard.py recorder/store/records.py recorder/store/journal.py" \
#     "tests/recorder/test_writer.py tests/recorder/test_integrity.py tests/recorder/test_tail.py"
#   mutants.sh 200 sim/fem/contact.py "tests/sim/test_fem_contact.py tests/sim/test_fem_friction.py tests/sim/test_fem_press.py"
#   mutants.sh 200 sim/fem/newton.py "tests/sim/test_fem_cg.py tests/sim/test_fem_failures.py tests/sim/test_fem_press.py"
# A mutant of contact compiles its kernel anew (10 to 30 s a core), so the tests of kernels on a mesh
# of 48 elements come first and end most runs; presses on small gels see what kernels alone cannot.
#   JOBS=16     copies that run at once (default: the cores)
#   TESTS_OF=REV  tests (and the benchmarks that they import) of another commit, on the same mutants
#   LIMIT=300   seconds of a mutant, after which it counts as caught
# Needs `pip install cosmic-ray` on PATH beside the checkout's own packages (PYTHON: its interpreter).
# The sample is the same each time. Tests that fail without a mutant end the run.
set -euo pipefail
count=$1 modules=$2 tests=$3 python=${PYTHON:-python} base=$(mktemp -d) jobs=${JOBS:-$(nproc)}
for ((job = 0; job < jobs; job++)); do
  copy=$base/$job
  mkdir "$copy"
  git archive HEAD | tar -x -C "$copy"
  if [ -n "${TESTS_OF:-}" ]; then
    rm -rf "$copy/tests" "$copy/benchmarks"
    git archive "$TESTS_OF" tests benchmarks | tar -x -C "$copy"
  fi
  list=$(printf '"%s",' $modules)
  cat > "$copy/cosmic-ray.toml" <<T
[cosmic-ray]
module-path = [${list%,}]
timeout = ${LIMIT:-300}.0
excluded-modules = []
test-command = "env PYTHONPATH=$copy OMP_NUM_THREADS=1 $python -m pytest -q -x -n 0 -p no:cacheprovider -m 'not slow and not serial' $tests"
[cosmic-ray.distributor]
name = "local"
T
done
cd "$base/0"
env PYTHONPATH="$base/0" "$python" -m pytest -q -x -n 0 -p no:cacheprovider -m 'not slow and not serial' $tests | tail -1
cosmic-ray init cosmic-ray.toml all.sqlite
"$python" - "$count" "$jobs" "$base" <<'P'
import random
import shutil
import sqlite3
import sys

count, jobs, base = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
rows = sqlite3.connect("all.sqlite").execute(
    "select job_id, module_path, operator_name, occurrence, start_pos_row from mutation_specs"
).fetchall()
rows.sort(key=lambda row: row[1:])
chosen = [row[0] for row in random.Random(57).sample(rows, min(count, len(rows)))]
for job in range(jobs):
    shutil.copy("all.sqlite", f"{base}/{job}/mutants.sqlite")
    part = sqlite3.connect(f"{base}/{job}/mutants.sqlite")
    own = set(chosen[job::jobs])
    for row in rows:
        if row[0] not in own:
            part.execute("delete from mutation_specs where job_id=?", row[:1])
            part.execute("delete from work_items where job_id=?", row[:1])
    part.commit()
P
for ((job = 0; job < jobs; job++)); do
  (cd "$base/$job" && cosmic-ray exec cosmic-ray.toml mutants.sqlite > exec.log 2>&1) &
done
wait
"$python" - "$jobs" "$base" <<'P'
import sqlite3
import sys

caught, lived = 0, []
for job in range(int(sys.argv[1])):
    part = sqlite3.connect(f"{sys.argv[2]}/{job}/mutants.sqlite")
    for outcome, *place in part.execute(
        "select test_outcome, module_path, start_pos_row, operator_name, occurrence"
        " from work_results join mutation_specs using (job_id)"
    ):
        if str(outcome).upper().endswith("SURVIVED"):
            lived.append(place)
        else:
            caught += 1
for place in sorted(lived):
    print("lived:", *place)
print(f"{caught} of {caught + len(lived)} mutants caught")
P
echo "in $base"
