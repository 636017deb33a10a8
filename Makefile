# Targets set up the venv if needed, then call `tactile`. `make` lists them.
SENSOR   ?= tacpalm
VENV     := .venv
PY       := $(VENV)/bin/python
PYTHON   ?= $(shell for p in python3.12 python3.11 python3; do \
              $$p -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' \
              2>/dev/null && echo $$p && break; done)
WORLDARG := $(if $(WORLD),--world $(WORLD))
FORCEARG := $(if $(FORCE),--force $(FORCE))
WORLDDEP := $(if $(WORLD),$(VENV)/.sim)
GIVEN    := $(sort $(foreach name,$(.VARIABLES),$(if $(filter command line,$(origin $(name))),$(name))))
BENCHARG := $(if $(BENCH),--bench $(BENCH)) $(if $(BENCH),$(if $(filter SENSOR,$(GIVEN)),--sensor $(SENSOR)),--sensor $(SENSOR)) $(WORLDARG)
SOURCES  := $(if $(CAMERA),--camera $(CAMERA)) $(if $(STILL),--still) $(if $(TAXELS),--taxels $(TAXELS))
WATCHARG := $(if $(WATCH),--watch $(filter-out 1,$(WATCH)))
DEMO     := examples/demo-learning
BARE     := examples/demo-transfer
LAUNCH   := $(if $(GPUS),$(VENV)/bin/torchrun --nproc-per-node $(GPUS),$(PY))
MKDOCS   := NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs
PIP      := $(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e

# A name that no target reads would be ignored by make, and `sensor=uskin` record a tacpalm. The
# options of a target, on the line above it, are the names that it may be given.
ifneq ($(GIVEN),)
REFUSED  := $(shell awk -v goals="$(MAKECMDGOALS)" -v given="$(GIVEN)" \
  'function least(a, b) {return a < b ? a : b} \
  function distance(a, b,  i, j, d) { \
    for (i = 0; i <= length(a); i++) for (j = 0; j <= length(b); j++) \
      d[i, j] = i * j == 0 ? i + j : least(least(d[i - 1, j], d[i, j - 1]) + 1, \
        d[i - 1, j - 1] + (substr(a, i, 1) != substr(b, j, 1))); \
    return d[length(a), length(b)]} \
  BEGIN {split(goals, each, " "); for (k in each) wanted[each[k]] = 1; \
    split("PY PYTHON PIP VENV", each, " "); for (k in each) allowed[each[k]] = 0} \
  $$0 ~ "^\\043: " {options = substr($$0, 4); next} \
  $$0 ~ "^[a-z][a-z -]*:.*  \\043\\043 " {names = $$0; sub(/:.*/, "", names); split(names, each, " "); \
    for (k in each) if (each[k] in wanted) {found = 1; text = options; \
      while (match(text, /[A-Z_]+=/)) {name = substr(text, RSTART, RLENGTH - 1); \
        if (!(name in allowed)) list = list ", " name; \
        allowed[name] = 1; text = substr(text, RSTART + RLENGTH)}}} \
  {options = ""} \
  END {n = split(given, each, " "); for (k = 1; found && k <= n; k++) if (!(each[k] in allowed)) { \
    near = ""; best = 3; for (name in allowed) if (allowed[name]) { \
      d = distance(toupper(each[k]), name); if (d < best) {best = d; near = name}} \
    printf "%s: unknown; %sallowed for %s: %s", each[k], \
      near == "" ? "" : "did you mean " near "? ", goals, list == "" ? "none" : substr(list, 3); exit}}' \
  $(firstword $(MAKEFILE_LIST)))
ifneq ($(REFUSED),)
$(error wrong input: $(REFUSED))
endif
endif

.PHONY: help accuracy speed simulate simulate-sensors markers press hard-cases refine collect resume home calibrate-latency force-depth campaign jog grip doctor setup-bench page mock replay check-session import train-field train-diffusion train-force translate compensate evaluate experiment bench-learning demo-learning demo-paper transfer calibrate-force demo-transfer demo-twin first-hour learning-tables learning-ablations learning-on-gpus live endurance faults bench-recorder test golden test-all check docs format reference setup clean

# Above a target: `##@` starts a group of the list, `#:` gives the options of the target.
help:
	@echo 'make TARGET; make help-TARGET shows its options'
	@awk '/^##@ / {printf "\n%s\n", substr($$0, 5)} \
	  /^[a-z][a-z -]*:.*  ## / {split($$0, part, "  ## "); sub(/:.*/, "", part[1]); \
	    n = split(part[1], names, " "); \
	    for (i = 1; i <= n; i++) printf "  %-18s  %s\n", names[i], part[2]}' $(firstword $(MAKEFILE_LIST))

help-%:
	@awk -v target='$*' '/^#: / {options = substr($$0, 4); next} \
	  /^[a-z][a-z -]*:.*  ## / {split($$0, part, "  ## "); sub(/:.*/, "", part[1]); \
	    n = split(part[1], names, " "); \
	    for (i = 1; i <= n; i++) if (names[i] == target) {found = 1; print part[2]; \
	      line = "  make " target; m = split(options, word, " "); \
	      for (k = 1; k <= m; k++) if (length(line word[k]) < 98) line = line " " word[k]; \
	        else {print line " \\"; line = "      " word[k]} \
	      print line}} \
	  {options = ""} \
	  END {if (!found) {print "no target " target "; make lists them"; exit 2}}' \
	  $(firstword $(MAKEFILE_LIST))

##@ Record

#: SENSOR=tacpalm [TARGETS=8] [INDENTER=cylinder] [OPERATOR=] [OUT=] [BENCH=file] [WORLD=sim] [FORCE=none] [CAMERA=path [STILL=1]] [TAXELS=path] [TRUTH=file] [WATCH=1|0.0.0.0:8765]
collect: $(VENV)/.rig $(WORLDDEP)  ## Record one session
	@$(PY) -m tactile collect $(BENCHARG) $(FORCEARG) $(SOURCES) $(if $(TARGETS),--targets $(TARGETS)) \
	  $(if $(INDENTER),--indenter $(INDENTER)) $(if $(OUT),--out $(OUT)) $(if $(TRUTH),--truth $(TRUTH)) $(if $(OPERATOR),--operator '$(OPERATOR)') $(WATCHARG)

#: SESSION=sessions/x.zarr [AGAIN=3,7] [BENCH=file] [WORLD=sim] [CAMERA=path [STILL=1]] [TAXELS=path] [WATCH=1|0.0.0.0:8765]
resume: $(VENV)/.rig $(WORLDDEP)  ## Continue a stopped session
	@$(PY) -m tactile collect $(if $(BENCH),--bench $(BENCH)) $(WORLDARG) $(SOURCES) --resume $(SESSION) $(if $(AGAIN),--again $(AGAIN)) $(WATCHARG)

#: [SESSIONS=sessions] [PORT=8766|0.0.0.0:8766]
page: $(VENV)/.rig  ## Sessions, replay, campaigns and set-up in the browser; nothing moves
	@$(PY) -m tactile page $(SESSIONS) $(if $(PORT),--port $(PORT))

#: SENSOR=tacpalm [INDENTER=] [CORNERS=1] [BENCH=file] [WORLD=sim] [FORCE=none]
home: $(VENV)/.rig $(WORLDDEP)  ## Find the surface by touch and store it in calibrations/
	@$(PY) -m tactile home $(BENCHARG) $(FORCEARG) $(if $(INDENTER),--indenter $(INDENTER)) $(if $(CORNERS),--corners)

#: SENSOR=tacpalm [INDENTER=] [BENCH=file] [WORLD=sim]
calibrate-latency: $(VENV)/.rig $(WORLDDEP)  ## Measure and store the camera's latency by light taps
	@$(PY) -m tactile calibrate-latency $(BENCHARG) $(if $(INDENTER),--indenter $(INDENTER))

#: SENSOR=tacpalm [INDENTER=prism] [OUT=] [BENCH=file] [WORLD=sim]
force-depth: $(VENV)/.rig $(WORLDDEP)  ## Press and release 3 times, write a table and the curve
	@$(PY) -m tactile force-depth $(BENCHARG) $(if $(INDENTER),--indenter $(INDENTER)) $(if $(OUT),--out $(OUT))

#: FILE=campaigns/day.yaml [LIST=1] [YES=1] [WORLD=sim] [KEEP_GOING=1]
campaign: $(VENV)/.rig $(WORLDDEP)  ## Record the remaining sessions of a campaign file
	@$(PY) -m tactile campaign --file $(FILE) $(if $(LIST),--list) $(if $(YES),--yes) $(WORLDARG) $(if $(KEEP_GOING),--keep-going)

#: SENSOR=tacpalm [BENCH=file] [WORLD=sim]
jog: $(VENV)/.rig $(WORLDDEP)  ## Move the arm with a SpaceMouse and set the contact origin
	@$(PY) -m tactile jog $(BENCHARG)

#: SENSOR=tacpalm [OPEN=1] [BENCH=file] [WORLD=sim]
grip: $(VENV)/.rig  ## Close the gripper on the indenter
	@$(PY) -m tactile grip $(BENCHARG) $(if $(OPEN),--open)

#: SENSOR=tacpalm [OUT=sessions] [BENCH=file] [WORLD=sim] [FORCE=none]
doctor: $(VENV)/.rig $(WORLDDEP)  ## Test all devices of a bench, and the computer; nothing moves
	@$(PY) -m tactile doctor $(BENCHARG) $(FORCEARG) $(if $(OUT),--out $(OUT))

#: SENSOR=tacpalm [INDENTER=] [YES=1] [OPERATOR=] [ONLY=gauge] [AGAIN=gauge] [OUT=sessions] [BENCH=file] [WORLD=sim] [FORCE=none]
setup-bench: $(VENV)/.rig $(WORLDDEP)  ## Set a bench up step by step, and write its acceptance report
	@$(PY) -m tactile setup $(BENCHARG) $(FORCEARG) $(if $(INDENTER),--indenter $(INDENTER)) $(if $(YES),--yes) $(if $(OPERATOR),--operator '$(OPERATOR)') $(foreach step,$(ONLY),--only $(step)) $(foreach step,$(AGAIN),--again $(step)) $(if $(OUT),--out $(OUT))

#: SENSOR=tacpalm [BENCH=file] [WORLD=sim] [FORCE=none] [CAMERA=path [STILL=1]] [TAXELS=path]
mock: $(VENV)/.rig $(WORLDDEP)  ## Run the emulators of a bench until Ctrl-C
	@$(PY) -m tactile mock $(BENCHARG) $(FORCEARG) $(SOURCES)

#: SESSION=sessions/x.zarr [SPEED=1|4|max] [OUT=] [WITHOUT=camera]
replay: $(VENV)/.rig  ## Play a session through mock hardware and record it again
	@$(PY) -m tactile replay --session $(SESSION) $(if $(SPEED),--speed $(SPEED)) $(if $(OUT),--out $(OUT)) $(foreach name,$(WITHOUT),--without $(name))

#: SESSION=sessions/x.zarr
check-session: $(VENV)/.rig  ## Check a session for problems
	@$(PY) -m tactile session check $(SESSION)

#: PATHS="video.mp4 force.csv" [OUT=session.zarr] [ARGS="--sensor digit --yes"]
import: $(VENV)/.markers  ## Make a session of recordings made elsewhere
	@$(PY) -m tactile import $(PATHS) $(if $(OUT),--out $(OUT)) $(ARGS)

#: MODEL=runs/x SENSOR=tacpalm [BENCH=file] [WORLD=sim] [FORCE=none] [SESSION=replayed.zarr] [BEFORE=runs/y] [ARGS="--seconds 10"]
live: $(VENV)/.live  ## Show forces as the sensor is pressed
	@$(PY) -m tactile live --model $(MODEL) $(if $(SESSION),--session $(SESSION),$(BENCHARG) $(FORCEARG)) $(if $(BEFORE),--before $(BEFORE)) $(ARGS)

##@ Simulate

#: [SHAPE=sphere] [DEPTHS=0.5,1,1.5] [TIER=layer] [OUT=press.png] [ARGS="--friction 0.5"]
press: $(VENV)/.sim  ## Simulate a press, write a table and a picture
	@$(PY) -m tactile sim press $(if $(SHAPE),--shape $(SHAPE)) $(if $(DEPTHS),--depths $(DEPTHS)) $(if $(TIER),--tier $(TIER)) $(if $(OUT),--out $(OUT)) $(ARGS)

#: [INDENTERS=sphere,cone] [PATTERNS=Array1,Circle1] [OUT=path] [DEVICE=cuda:0] [ARGS="--scale smoke"]
simulate: $(VENV)/.sim  ## Write a marker archive of the paper's 810 states under 12 patterns
	@$(PY) -m tactile sim archive states$(if $(PATTERNS),:$(PATTERNS)) $(if $(INDENTERS),--indenters $(INDENTERS)) $(if $(OUT),--out $(OUT)) $(if $(DEVICE),--device $(DEVICE)) $(ARGS)

#: [GROUP=homogeneous|material|heterogeneous] [SCALE=smoke|0.1|full] [INDENTERS=sphere,cone] [OUT=path] [DEVICE=cuda:0] [ARGS="--tier layer"]
simulate-sensors: $(VENV)/.sim  ## Write an archive of real trajectories with forces on simulated sensors
	@$(PY) -m tactile sim archive $(or $(GROUP),homogeneous) --scale $(or $(SCALE),0.1) $(if $(INDENTERS),--indenters $(INDENTERS)) $(if $(OUT),--out $(OUT)) $(if $(DEVICE),--device $(DEVICE)) $(ARGS)

##@ Learn

#: SESSIONS="a.zarr b.zarr" OUT=x.markers.zarr [ARGS="--preset NAME"]
markers: $(VENV)/.markers  ## Make a marker archive of recorded sessions
	@$(PY) -m tactile markers $(SESSIONS) --out $(OUT) --sheet $(OUT:.zarr=.png) $(ARGS)

#: ARCHIVE= OUT=runs/x [SPLIT=split.json] [PRESET=ours] [GPUS=4] [ARGS="--resume --set key=value"]
train-field train-diffusion: $(VENV)/.learning  ## Train a translator
	@$(LAUNCH) -m tactile $(subst train-,train ,$@) $(ARCHIVE) $(if $(SPLIT),--split $(SPLIT)) --out $(OUT) $(if $(PRESET),--preset $(PRESET)) $(ARGS)

#: ARCHIVE= SOURCE=a TARGET=b MODEL=flow|runs/x OUT=x.markers.zarr [ARGS="--sheet x.png"]
translate: $(VENV)/.learning  ## Translate frames of one sensor into frames of another
	@$(PY) -m tactile translate $(ARCHIVE) --source $(SOURCE) --target $(TARGET) --model $(or $(MODEL),flow) --out $(OUT) $(ARGS)

#: ARCHIVE= OUT=file.json [ARGS="--split split.json"]
compensate: $(VENV)/.learning  ## Fit material priors and choose how labels are scaled between skins
	@$(PY) -m tactile compensate $(ARCHIVE) --out $(OUT) $(ARGS)

#: ARCHIVE= SENSOR= OUT=runs/x [SPLIT=split.json] [PRESET=paper] [GPUS=4] [ARGS="--labels file.json"]
train-force: $(VENV)/.learning  ## Train a force model
	@$(LAUNCH) -m tactile train force $(ARCHIVE) --sensor $(SENSOR) $(if $(SPLIT),--split $(SPLIT)) --out $(OUT) $(if $(PRESET),--preset $(PRESET)) $(ARGS)

#: FOLDER=results OUT=report [ARGS="--help"]
evaluate: $(VENV)/.learning  ## Write the report of predictions and translations
	@$(PY) -m tactile evaluate $(FOLDER) --out $(OUT) $(ARGS)

#: ARCHIVE= OUT=dir [PRESET=demo] [ARGS="--pairs a:b --device cuda:0"]
experiment: $(VENV)/.learning  ## Translate, train, compensate and evaluate all pairs
	@$(PY) -m tactile experiment $(ARCHIVE) --out $(OUT) $(if $(PRESET),--preset $(PRESET)) $(ARGS)

#: [OUT=folder] [ARGS="--venv DIR"]
first-hour: $(VENV)/.rig  ## Run all commands from wheel to live forces on a mock bench (15 minutes)
	@$(PY) -m benchmarks first-hour $(if $(OUT),--out $(OUT)) $(ARGS)

#: [OUT=runs/demo-learning]
demo-learning: $(VENV)/.demo  ## Run three simulated sensors from press to report on two cores (10 minutes)
	@$(PY) -m tactile sim archive $(DEMO)/array-hard.yaml,$(DEMO)/circle.yaml,$(DEMO)/diamond-soft.yaml --tier layer --scale 0.025 --steps 4 --no-check --out $(or $(OUT),runs/demo-learning)/demo.markers.zarr
	@$(PY) -m tactile experiment $(or $(OUT),runs/demo-learning)/demo.markers.zarr --out $(or $(OUT),runs/demo-learning) --preset demo --pairs array-hard:circle,array-hard:diamond-soft

#: [OUT=runs/demo-paper]
demo-paper: $(VENV)/.chain  ## Train the paper's chain at toy size on two cores (10 minutes)
	@$(PY) -m benchmarks paper-chain --out $(or $(OUT),runs/demo-paper) --size toy --minutes 1 --gpus cpu

#: [OUT=runs/twin-demo]
demo-twin: $(VENV)/.rig $(VENV)/.sim  ## Record a mock sensor and identify its twin on two cores (10 minutes)
	@$(PY) -m benchmarks twin-demo $(if $(OUT),--out $(OUT))

#: SOURCE=a.markers.zarr:a TARGET=b.markers.zarr:b OUT=runs/x [ARGS="--priors session.zarr"]
transfer: $(VENV)/.learning  ## Train a force model of a sensor without a gauge, with error bars
	@$(PY) -m tactile transfer --source $(SOURCE) --target $(TARGET) --out $(OUT) $(ARGS)

#: MODEL=runs/x/model WEIGHTS=50g,100g,200g HOLDS=holds.csv OUT=runs/x/weighed [ARGS="--carrier 20g"]
calibrate-force: $(VENV)/.learning  ## Set the scale of such a model by weights laid on the sensor
	@$(PY) -m tactile calibrate-force $(MODEL) --weights $(WEIGHTS) --holds $(HOLDS) --out $(OUT) $(ARGS)

#: [OUT=runs/demo-transfer]
demo-transfer: $(VENV)/.demo  ## Newtons on a simulated sensor without a gauge (10 minutes, two cores)
	@for name in gauge bare; do $(PY) -m tactile sim archive $(BARE)/$$name.yaml --tier layer --scale 0.025 --steps 4 --no-check --out $(or $(OUT),runs/demo-transfer)/$$name.markers.zarr || exit; done
	@$(PY) -m tactile transfer --source $(or $(OUT),runs/demo-transfer)/gauge.markers.zarr:gauge --target $(or $(OUT),runs/demo-transfer)/bare.markers.zarr:bare --out $(or $(OUT),runs/demo-transfer)
	@rm -rf $(or $(OUT),runs/demo-transfer)/weighed
	@$(PY) -m tactile calibrate-force $(or $(OUT),runs/demo-transfer)/model $$($(PY) $(BARE)/weigh.py $(or $(OUT),runs/demo-transfer)/bare.markers.zarr:bare 50,200,400) --out $(or $(OUT),runs/demo-transfer)/weighed
	@$(PY) -m tactile score-transfer $(or $(OUT),runs/demo-transfer)/weighed $(or $(OUT),runs/demo-transfer)/bare.markers.zarr:bare

##@ Measure (pages are in docs/results/)

#: [QUICK=1] [ONLY=row] [KILLS=100]
faults: $(VENV)/.nidaq  ## Inject every fault into a mock bench: reliability.md (half an hour)
	@$(PY) -m benchmarks faults $(if $(QUICK),--quick) $(if $(ONLY),--only $(ONLY)) $(if $(KILLS),--kills $(KILLS))

#: SENSOR=tacpalm [BENCH=file] [WORLD=sim] [MINUTES=30] [OUT=docs/results/endurance.md]
endurance: $(VENV)/.rig  ## Monitor a long mock collection: endurance.md (half an hour)
	@$(PY) -m benchmarks endurance $(BENCHARG) $(if $(MINUTES),--minutes $(MINUTES)) $(if $(OUT),--out $(OUT))

#: [QUICK=1] [ONLY=part] [OUT=page.md]
bench-recorder: $(VENV)/.bench  ## Measure the cost of recording: recording.md (12 minutes)
	@$(PY) -m benchmarks recording $(if $(QUICK),--quick) $(foreach part,$(ONLY),--only $(part)) $(if $(OUT),--out $(OUT))

#: [ONLY=case] [PLANTED=all] [RANDOM=300 [SEED=1]] [DEVICE=cuda:0] [OUT=page.md] [ARGS="--scene 17"]
hard-cases: $(VENV)/.sim  ## Simulate cases that break simulators: stability.md (10 minutes)
	@$(PY) -m benchmarks hard-cases $(foreach case,$(ONLY),--only '$(case)') $(if $(PLANTED),--planted $(PLANTED)) $(if $(RANDOM),--random $(RANDOM)) $(if $(SEED),--seed $(SEED)) $(if $(DEVICE),--device $(DEVICE)) $(if $(OUT),--out $(OUT)) $(ARGS)

#: [ONLY=bench|shapes] [DEVICE=cuda:0] [OUT=page.md]
refine: $(VENV)/.sim  ## Refine the meshes of all 18 shapes: refinement.md (hours on a CPU)
	@$(PY) -m benchmarks refine $(if $(ONLY),--only $(ONLY)) $(if $(DEVICE),--device $(DEVICE)) $(if $(OUT),--out $(OUT))

#: [ONLY=measure|page] [DEVICE=cuda:0] [OUT=docs/results/accuracy] [ARGS="--case sphere --smoke"]
accuracy: $(VENV)/.sim  ## Measure error, time, memory of all tiers and meshes: accuracy.md (15 minutes)
	@$(PY) -m benchmarks accuracy $(if $(ONLY),--only $(ONLY)) $(if $(DEVICE),--device $(DEVICE)) $(if $(OUT),--out $(OUT)) $(ARGS)

#: [ONLY=presses,steps,page] [DEVICE=cuda:0] [OUT=docs/results/speed] [ARGS="--again --smoke"]
speed: $(VENV)/.sim  ## Time the paper's 162 presses and each optimisation: speed.md (20 minutes)
	@$(PY) -m benchmarks speed $(if $(ONLY),--only $(ONLY)) $(if $(DEVICE),--device $(DEVICE)) $(if $(OUT),--out $(OUT)) $(ARGS)

#: [ARGS="--model runs/x --archive x.markers.zarr"]
bench-learning: $(VENV)/.learning  ## Time force models, one frame at a time
	@$(PY) -m benchmarks latency $(ARGS)

#: [OUT=runs/tables] [TABLES="material homogeneous-full"] [DEVICE=cuda:0] [JOBS=8]
learning-tables: $(VENV)/.demo  ## Write the paper's tables for simulated groups of sensors, on a GPU
	@PYTHON=$(PY) DEVICE=$(DEVICE) JOBS=$(JOBS) bash benchmarks/learning/tables/run.sh $(or $(OUT),runs/tables) $(TABLES)

#: [OUT=runs/tables] [NAMES="half single-frame"] [DEVICE=cuda:0] [JOBS=8]
learning-ablations: $(VENV)/.demo  ## Write the ablations of these tables; run after learning-tables
	@PYTHON=$(PY) DEVICE=$(DEVICE) JOBS=$(JOBS) bash benchmarks/learning/tables/ablations.sh $(or $(OUT),runs/tables) $(NAMES)

#: [OUT=runs/tables] [ARGS="--only material,half --gpus 0,1"]
learning-on-gpus: $(VENV)/.demo  ## Run all of these tables and ablations in parallel on all GPUs
	@$(PY) -m benchmarks learning-on-gpus $(or $(OUT),runs/tables) $(ARGS)

##@ Develop

test: $(VENV)/.dev  ## Run the default tests (about 6 minutes on 2 cores)
	@$(PY) -m pytest -q -n 3 --dist worksteal -m 'not serial' --ignore tests/golden
	@$(PY) -m pytest -q -m serial --ignore tests/golden

#: [ARGS="--slow | --only NAME"]
golden: $(VENV)/.dev  ## Compare every command with its recorded results (3 minutes)
	@$(PY) tests/golden/replay.py -j 2 $(ARGS)

test-all: $(VENV)/.dev  ## Run all tests, including the slow ones
	@RUN_SLOW=1 $(PY) -m pytest -q --durations=10

check: $(VENV)/.dev  ## Check lint, format, types, layers of imports, spelling, prose and docs
	@$(PY) -m ruff check . && $(PY) -m ruff format --check . && $(PY) -m mypy && $(VENV)/bin/lint-imports --no-logo
	@$(VENV)/bin/codespell && $(PY) tests/support/prose.py && $(MKDOCS) build

#: [SERVE=1]
docs: $(VENV)/.dev  ## Build the documentation in build/docs; SERVE=1 shows it on a local page
	@$(MKDOCS) $(if $(SERVE),serve,build)

reference: $(VENV)/.rig  ## Write docs/reference from the commands and packages
	@$(PY) tests/support/reference.py

format: $(VENV)/.dev  ## Format the code
	@$(PY) -m ruff format . && $(PY) -m ruff check --fix .

setup: $(VENV)/.rig  ## Create the venv and install the dependencies of recording


clean:  ## Remove the venv and caches, keep sessions
	rm -rf $(VENV) build *.egg-info .mypy_cache .pytest_cache .ruff_cache

$(VENV)/bin/python:
	@test -n "$(PYTHON)" || { echo "Python 3.11 or 3.12 is needed (ur-rtde has no wheel for others)"; exit 2; }
	@echo "setting up $(VENV) with $(PYTHON), once ..."
	@$(PYTHON) -m venv $(VENV)

$(VENV)/.rig: pyproject.toml constraints.txt | $(VENV)/bin/python
	@$(PIP) '.[rig]' && touch $@

$(VENV)/.sim: pyproject.toml constraints.txt | $(VENV)/bin/python
	@$(PIP) '.[sim]' && touch $@

$(VENV)/.markers: pyproject.toml constraints.txt | $(VENV)/bin/python
	@$(PIP) '.[markers]' && touch $@

$(VENV)/.learning: pyproject.toml constraints.txt | $(VENV)/bin/python
	@$(PIP) '.[learning]' && touch $@ $(VENV)/.markers

$(VENV)/.demo: pyproject.toml constraints.txt | $(VENV)/bin/python
	@$(PIP) '.[learning,sim]' && touch $@ $(VENV)/.learning $(VENV)/.sim

$(VENV)/.chain: pyproject.toml constraints.txt | $(VENV)/bin/python
	@$(PIP) '.[diffusion,sim]' && touch $@ $(VENV)/.demo $(VENV)/.learning $(VENV)/.sim

$(VENV)/.live: pyproject.toml constraints.txt | $(VENV)/bin/python
	@$(PIP) '.[rig,learning]' && touch $@ $(VENV)/.rig $(VENV)/.learning

$(VENV)/.nidaq: pyproject.toml constraints.txt | $(VENV)/bin/python
	@$(PIP) '.[rig,nidaq]' && touch $@ $(VENV)/.rig

$(VENV)/.bench: pyproject.toml constraints.txt | $(VENV)/bin/python
	@$(PIP) '.[rig,bench]' && touch $@ $(VENV)/.rig

$(VENV)/.dev: pyproject.toml constraints.txt | $(VENV)/bin/python
	@$(PIP) '.[rig,dev]' && touch $@ $(VENV)/.rig $(VENV)/.learning $(VENV)/.demo $(VENV)/.chain $(VENV)/.live
