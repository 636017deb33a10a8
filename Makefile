# The lab's front door: every target only calls `python -m ...`. `make` lists them.
SENSOR   ?= tacpalm
VENV     := .venv
PY       := $(VENV)/bin/python
PYTHON   ?= $(shell for p in python3.12 python3.11 python3; do \
              $$p -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' \
              2>/dev/null && echo $$p && break; done)
WORLDARG := $(if $(WORLD),--world $(WORLD))
WORLDDEP := $(if $(WORLD),$(VENV)/.sim)
BENCHARG := $(if $(BENCH),--bench $(BENCH),--sensor $(SENSOR)) $(WORLDARG)
SOURCES  := $(if $(CAMERA),--camera $(CAMERA)) $(if $(STILL),--still) $(if $(TAXELS),--taxels $(TAXELS))
WATCHARG := $(if $(WATCH),--watch $(filter-out 1,$(WATCH)) $(if $(WATCHHOST),--watch-host $(WATCHHOST)))
DEMO     := examples/demo-learning
LAUNCH   := $(if $(GPUS),$(VENV)/bin/torchrun --nproc-per-node $(GPUS),$(PY))
PIP      := $(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e

.PHONY: help accuracy cost-table speed simulate simulate-sensors markers press hard-cases refine collect resume home calibrate-latency force-depth campaign jog grip preview compare mock replay check-session split train-field train-autoencoder train-direct train-marker-vae train-diffusion train-force translate compensate evaluate experiment bench-learning demo-learning learning-tables learning-ablations learning-on-gpus live endurance faults bench-recorder test test-all check format setup clean

help:  ## Show this list
	@awk -F ':.*## ' '/^[a-z -]+:.*## /{printf "  make %-14s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

collect: $(VENV)/.rig $(WORLDDEP)  ## Record one session: SENSOR=tacpalm [TARGETS=8] [INDENTER=cylinder] [OPERATOR=] [OUT=] [BENCH=file] [WORLD=sim] [CAMERA=path [STILL=1]] [TAXELS=path] [TRUTH=file] [WATCH=1 [WATCHHOST=0.0.0.0]]
	@$(PY) -m rig collect $(BENCHARG) $(SOURCES) $(if $(TARGETS),--targets $(TARGETS)) \
	  $(if $(INDENTER),--indenter $(INDENTER)) $(if $(OUT),--out $(OUT)) $(if $(TRUTH),--truth $(TRUTH)) $(if $(OPERATOR),--operator $(OPERATOR)) $(WATCHARG)

resume: $(VENV)/.rig $(WORLDDEP)  ## Continue a stopped session: SESSION=sessions/x.zarr [BENCH=file] [WATCH=1]
	@$(PY) -m rig collect $(if $(BENCH),--bench $(BENCH)) $(WORLDARG) $(SOURCES) --resume $(SESSION) $(WATCHARG)

home: $(VENV)/.rig $(WORLDDEP)  ## Find the surface by touch, keep it in calibrations/: SENSOR=tacpalm [INDENTER=] [CORNERS=1] [BENCH=file] [WORLD=sim]
	@$(PY) -m rig home $(BENCHARG) $(if $(INDENTER),--indenter $(INDENTER)) $(if $(CORNERS),--corners)

calibrate-latency: $(VENV)/.rig $(WORLDDEP)  ## Tap lightly, keep how late the camera is: SENSOR=tacpalm [INDENTER=] [BENCH=file] [WORLD=sim]
	@$(PY) -m rig calibrate-latency $(BENCHARG) $(if $(INDENTER),--indenter $(INDENTER))

force-depth: $(VENV)/.rig $(WORLDDEP)  ## Press and release 3 times, table and curve: SENSOR=tacpalm [INDENTER=prism] [OUT=] [BENCH=file] [WORLD=sim]
	@$(PY) -m rig force-depth $(BENCHARG) $(if $(INDENTER),--indenter $(INDENTER)) $(if $(OUT),--out $(OUT))

campaign: $(VENV)/.rig  ## Record what is left of a day: FILE=campaigns/day.yaml [LIST=1] [YES=1] [KEEP_GOING=1]
	@$(PY) -m rig campaign --file $(FILE) $(if $(LIST),--list) $(if $(YES),--yes) $(if $(KEEP_GOING),--keep-going)

jog: $(VENV)/.rig $(WORLDDEP)  ## Move the arm by a SpaceMouse, take the contact origin: SENSOR=tacpalm [BENCH=file]
	@$(PY) -m rig jog $(BENCHARG)

grip: $(VENV)/.rig  ## Close the gripper on the indenter: SENSOR=tacpalm [OPEN=1] [BENCH=file]
	@$(PY) -m rig grip $(BENCHARG) $(if $(OPEN),--open)

preview: $(VENV)/.rig  ## Draw the plan and check its limits: SENSOR=tacpalm [OUT=plan.png]
	@$(PY) -m rig preview $(BENCHARG) $(if $(OUT),--out $(OUT))

compare: $(VENV)/.rig  ## Hold a mock session against the World's truth: SESSION= TRUTH=
	@$(PY) -m rig compare --session $(SESSION) --truth $(TRUTH)

mock: $(VENV)/.rig $(WORLDDEP)  ## Run the emulators of a bench until Ctrl-C: SENSOR=tacpalm
	@$(PY) -m rig mock $(BENCHARG) $(SOURCES)

replay: $(VENV)/.rig  ## Play a session through mock hardware and record it again: SESSION=sessions/x.zarr [SPEED=1|4|max] [OUT=] [WITHOUT=camera]
	@$(PY) -m rig replay --session $(SESSION) $(if $(SPEED),--speed $(SPEED)) $(if $(OUT),--out $(OUT)) $(foreach name,$(WITHOUT),--without $(name))

check-session: $(VENV)/.rig  ## Look for faults in a session: SESSION=sessions/x.zarr
	@$(PY) -m recorder check $(SESSION)

endurance: $(VENV)/.rig  ## A long mock collection, watched: SENSOR=tacpalm [MINUTES=30] [OUT=docs/results/endurance.md]
	@$(PY) -m benchmarks endurance $(BENCHARG) $(if $(MINUTES),--minutes $(MINUTES)) $(if $(OUT),--out $(OUT))

faults: $(VENV)/.nidaq  ## Break a mock bench in every way, write docs/results/reliability.md: [QUICK=1] [ONLY=row] [KILLS=100] (half an hour)
	@$(PY) -m benchmarks faults $(if $(QUICK),--quick) $(if $(ONLY),--only $(ONLY)) $(if $(KILLS),--kills $(KILLS))

bench-recorder: $(VENV)/.bench  ## Measure what recording costs, write docs/results/recording.md: [QUICK=1] [ONLY=part] [OUT=page.md] (12 minutes)
	@$(PY) -m benchmarks recording $(if $(QUICK),--quick) $(foreach part,$(ONLY),--only $(part)) $(if $(OUT),--out $(OUT))

press: $(VENV)/.sim  ## Simulate a press, table and picture: [SHAPE=sphere] [DEPTHS=0.5,1,1.5] [TIER=layer] [OUT=press.png] [ARGS="--friction 0.5 --mesh 1"]
	@$(PY) -m sim press $(if $(SHAPE),--shape $(SHAPE)) $(if $(DEPTHS),--depths $(DEPTHS)) $(if $(TIER),--tier $(TIER)) $(if $(OUT),--out $(OUT)) $(ARGS)

hard-cases: $(VENV)/.sim  ## Simulate what breaks simulators, write docs/results/stability.md: [ONLY=case] [PLANTED=all] [DEVICE=cuda:0] [OUT=page.md] (10 minutes)
	@$(PY) -m benchmarks hard-cases $(foreach case,$(ONLY),--only '$(case)') $(if $(PLANTED),--planted $(PLANTED)) $(if $(DEVICE),--device $(DEVICE)) $(if $(OUT),--out $(OUT))

refine: $(VENV)/.sim  ## Force and surface from coarse to fine meshes, all 18 shapes, write docs/results/refinement.md: [ONLY=bench|shapes] [DEVICE=cuda:0] [OUT=page.md] (hours on a CPU)
	@$(PY) -m benchmarks refine $(if $(ONLY),--only $(ONLY)) $(if $(DEVICE),--device $(DEVICE)) $(if $(OUT),--out $(OUT))

accuracy: $(VENV)/.sim  ## Error, time and memory of every tier and mesh, write docs/results/accuracy.md: [ONLY=measure|page] [DEVICE=cuda:0] [OUT=docs/results/accuracy] [ARGS="--case sphere --smoke"] (15 minutes)
	@$(PY) -m benchmarks accuracy $(if $(ONLY),--only $(ONLY)) $(if $(DEVICE),--device $(DEVICE)) $(if $(OUT),--out $(OUT)) $(ARGS)

cost-table: $(VENV)/.sim  ## What errors cost, for simulate(tolerance=...), write docs/results/cost-table.md: [ARGS="--validate | --seconds | --page | --take DIR"] [DEVICE=cuda:0] [OUT=page.md] (an hour)
	@$(PY) -m benchmarks cost-table $(if $(DEVICE),--device $(DEVICE)) $(if $(OUT),--out $(OUT)) $(ARGS)

speed: $(VENV)/.sim  ## The paper's 162 presses timed, what each step is worth, the floor, write docs/results/speed.md: [ONLY=presses,steps,page] [DEVICE=cuda:0] [OUT=docs/results/speed] [ARGS="--again --smoke"] (20 minutes)
	@$(PY) -m benchmarks speed $(if $(ONLY),--only $(ONLY)) $(if $(DEVICE),--device $(DEVICE)) $(if $(OUT),--out $(OUT)) $(ARGS)

simulate: $(VENV)/.sim  ## The paper's 810 states under 12 patterns, a marker archive: [INDENTERS=sphere,cone] [PATTERNS=Array1,Circle1] [OUT=path] [DEVICE=cuda:0] [ARGS="--smoke"]
	@$(PY) -m sim archive states $(if $(INDENTERS),--indenters $(INDENTERS)) $(if $(PATTERNS),--patterns $(PATTERNS)) $(if $(OUT),--out $(OUT)) $(if $(DEVICE),--device $(DEVICE)) $(ARGS)

simulate-sensors: $(VENV)/.sim  ## Real trajectories with forces on simulated sensors: [GROUP=homogeneous|material|heterogeneous] [SCALE=smoke|0.1|full] [OUT=path] [DEVICE=cuda:0] [ARGS="--tier layer"]
	@$(PY) -m sim archive sensors --group $(or $(GROUP),homogeneous) --scale $(or $(SCALE),0.1) $(if $(INDENTERS),--indenters $(INDENTERS)) $(if $(OUT),--out $(OUT)) $(if $(DEVICE),--device $(DEVICE)) $(ARGS)

markers: $(VENV)/.markers  ## Marker archive of sessions: SESSIONS="a.zarr b.zarr" OUT=x.markers.zarr [ARGS="--preset NAME --rate"]
	@$(PY) -m learning markers $(SESSIONS) --out $(OUT) --sheet $(OUT:.zarr=.png) $(ARGS)

split: $(VENV)/.learning  ## Say which presses train and which test: ARCHIVE=x.markers.zarr [OUT=split.json] [ARGS="--new-press 0.2"]
	@$(PY) -m learning split $(ARCHIVE) --out $(or $(OUT),$(ARCHIVE:.markers.zarr=.split.json)) $(ARGS)

train-field train-autoencoder train-direct train-marker-vae train-diffusion: $(VENV)/.learning  ## Train a translator: ARCHIVE= SPLIT= OUT=runs/x [PRESET=ours] [GPUS=4] [ARGS="--resume --set key=value"]
	@$(LAUNCH) -m learning $@ $(ARCHIVE) --split $(SPLIT) --out $(OUT) $(if $(PRESET),--preset $(PRESET)) $(ARGS)

train-force: $(VENV)/.learning  ## Train a force model: ARCHIVE= SENSOR= SPLIT= OUT=runs/x [PRESET=half] [GPUS=4] [ARGS="--compensation file.json"]
	@$(LAUNCH) -m learning train-force $(ARCHIVE) --sensor $(SENSOR) --split $(SPLIT) --out $(OUT) $(if $(PRESET),--preset $(PRESET)) $(ARGS)

translate: $(VENV)/.learning  ## Show frames of a sensor as another's: ARCHIVE= SOURCE=a TARGET=b MODEL=flow|runs/x OUT=x.markers.zarr [ARGS="--sheet x.png"]
	@$(PY) -m learning translate $(ARCHIVE) --source $(SOURCE) --target $(TARGET) --model $(or $(MODEL),flow) --out $(OUT) $(ARGS)

compensate: $(VENV)/.learning  ## Priors of skins, and how labels are brought from one to another: ARCHIVE= OUT=file.json [ARGS="--split split.json"]
	@$(PY) -m learning compensate $(ARCHIVE) --out $(OUT) $(ARGS)

evaluate: $(VENV)/.learning  ## Report of predictions and translations: FOLDER=results OUT=report
	@$(PY) -m learning evaluate $(FOLDER) --out $(OUT) $(ARGS)

experiment: $(VENV)/.learning  ## Translate, train, compensate, evaluate, all pairs: ARCHIVE= OUT=dir [PRESET=demo] [ARGS="--pairs a:b --device cuda:0"]
	@$(PY) -m learning experiment $(ARCHIVE) --out $(OUT) $(if $(PRESET),--preset $(PRESET)) $(ARGS)

bench-learning: $(VENV)/.learning  ## Time force models, a frame at a time: [ARGS="--model runs/x --archive x.markers.zarr"]
	@$(PY) -m benchmarks latency $(ARGS)

demo-learning: $(VENV)/.demo  ## Three simulated sensors, from press to report, on two cores (10 minutes): [OUT=runs/demo-learning]
	@$(PY) -m sim archive sensors --sensors $(DEMO)/array-hard.yaml,$(DEMO)/circle.yaml,$(DEMO)/diamond-soft.yaml --tier layer --scale 0.025 --steps 4 --no-check --out $(or $(OUT),runs/demo-learning)/demo.markers.zarr
	@$(PY) -m learning experiment $(or $(OUT),runs/demo-learning)/demo.markers.zarr --out $(or $(OUT),runs/demo-learning) --preset demo --pairs array-hard:circle,array-hard:diamond-soft

learning-tables: $(VENV)/.demo  ## The paper's tables on simulated groups of sensors, for a GPU: [OUT=runs/tables] [TABLES="material homogeneous-full"] [DEVICE=cuda:0] [JOBS=8]
	@PYTHON=$(PY) DEVICE=$(DEVICE) JOBS=$(JOBS) bash benchmarks/learning/tables/run.sh $(or $(OUT),runs/tables) $(TABLES)

learning-ablations: $(VENV)/.demo  ## What limits them, one thing changed at a time, behind learning-tables: [OUT=runs/tables] [NAMES="half single-frame"] [DEVICE=cuda:0] [JOBS=8]
	@PYTHON=$(PY) DEVICE=$(DEVICE) JOBS=$(JOBS) bash benchmarks/learning/tables/ablations.sh $(or $(OUT),runs/tables) $(NAMES)

learning-on-gpus: $(VENV)/.demo  ## All of these tables and ablations side by side, on all GPUs: [OUT=runs/tables] [ARGS="--only material,half --gpus 0,1"]
	@$(PY) benchmarks/learning/tables/on_gpus.py $(or $(OUT),runs/tables) $(ARGS)

live: $(VENV)/.live  ## Forces from the sensor as it is pressed: MODEL=runs/x SENSOR=tacpalm [BENCH=file] [SESSION=replayed.zarr] [ARGS="--seconds 10"]
	@$(PY) -m rig live --model $(MODEL) $(if $(SESSION),--session $(SESSION),$(BENCHARG)) $(ARGS)

test: $(VENV)/.dev  ## Run the default tests (about 8 minutes on 2 cores)
	@$(PY) -m pytest -q -n 2 --dist worksteal -m 'not serial'
	@$(PY) -m pytest -q -m serial

test-all: $(VENV)/.dev  ## Run all tests, the slow ones too
	@RUN_SLOW=1 $(PY) -m pytest -q --durations=10

check: $(VENV)/.dev  ## Lint, format check, types, who may import whom
	@$(PY) -m ruff check . && $(PY) -m ruff format --check . && $(PY) -m mypy && $(VENV)/bin/lint-imports --no-logo

format: $(VENV)/.dev  ## Format the code
	@$(PY) -m ruff format . && $(PY) -m ruff check --fix .

setup: $(VENV)/.rig  ## Make the venv and install what recording needs

clean:  ## Remove the venv and caches (sessions stay)
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

$(VENV)/.live: pyproject.toml constraints.txt | $(VENV)/bin/python
	@$(PIP) '.[rig,learning]' && touch $@ $(VENV)/.rig $(VENV)/.learning

$(VENV)/.nidaq: pyproject.toml constraints.txt | $(VENV)/bin/python
	@$(PIP) '.[rig,nidaq]' && touch $@ $(VENV)/.rig

$(VENV)/.bench: pyproject.toml constraints.txt | $(VENV)/bin/python
	@$(PIP) '.[rig,bench]' && touch $@ $(VENV)/.rig

$(VENV)/.dev: pyproject.toml constraints.txt | $(VENV)/bin/python
	@$(PIP) '.[rig,dev]' && touch $@ $(VENV)/.rig $(VENV)/.learning $(VENV)/.demo $(VENV)/.live
