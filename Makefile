# `make` lists the targets. Each sets up the venv if needed, then runs a command of `tactile` or of Python.
VENV    := .venv
PY      := $(VENV)/bin/python
TACTILE := $(PY) -m tactile
# ur-rtde has wheels for these: the first that runs, those of pyenv and uv included.
FITS    := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))
PYTHON  ?= $(shell for p in python3.12 python3.11 python3 ~/.pyenv/versions/3.1[21].*/bin/python \
            $$(uv python find '>=3.11,<3.13' 2>/dev/null); do \
            $$p -c '$(FITS)' 2>/dev/null && echo $$p && break; done)
# Bytecode is left to the first import: most of the modules are never imported.
PIP     := $(if $(shell command -v uv 2>/dev/null),uv pip install --python $(PY),PYTHONWARNINGS=ignore \
            $(PY) -m pip install --no-compile --disable-pip-version-check) --quiet -c constraints.txt
MKDOCS  := NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs
BARE    := examples/demo-transfer
DEMO    := examples/demo-learning
SMALL   := --tier layer --scale 0.025 --steps 4 --no-check
ALL     := docs rig-sim learning-sim diffusion-sim
SLOW    := RUN_SLOW=1 $(PY) -m pytest -q --durations=10
comma   := ,
# A variable counts if it is typed after `make`; one of that name in the environment (HOST) does not.
given   = $(if $(filter command,$(origin $(1))),$(value $(1)))
quoted  = '$(subst ','\'',$(1))'
# SENSOR=tacpalm becomes --sensor 'tacpalm', for each of these variables that is given.
option  = $(if $(call given,$(1)),--$(shell echo $(1) | tr A-Z a-z) $(call quoted,$(call given,$(1))))
options = $(foreach name,$(1),$(call option,$(name))) $(call given,ARGS)
folder  = $(call quoted,$(or $(call given,OUT),$(1)))

# Names are checked before anything is installed: make itself ignores a variable that no target reads.
TYPED   := $(foreach name,$(.VARIABLES),$(if $(filter command,$(origin $(name))),$(name)))
ifneq ($(TYPED),)
WRONG   := $(shell $(or $(PYTHON),python3) tests/support/make_names.py $(call quoted,$(MAKECMDGOALS)) \
            $(foreach name,$(TYPED),$(call quoted,$(name)=$(value $(name)))) \
            || echo "PYTHON: found $(PYTHON), which does not run; allowed: Python 3.11 or later")
$(if $(WRONG),$(error wrong input: $(WRONG)))
endif

.PHONY: help collect resume campaign replay demo-learning demo-transfer demo-twin demo-paper demo-grasp \
  test test-slow-sim test-slow-rest check docs reference format setup clean

help:
	@echo 'make TARGET [NAME=value ...]; ARGS="..." are further options; tactile --help lists the commands'
	@sed -n -e 's/^##@ /\n/p' -e 's/^\([a-z-]*\):.*  ## /  \1	/p' Makefile | expand -t 18

##@ Record
collect: $(VENV)/.rig$(if $(call given,WORLD),-sim)  ## SENSOR=tacpalm TARGETS=8: record one session
	@$(TACTILE) collect $(call options,SENSOR BENCH TARGETS INDENTER OPERATOR OUT WORLD FORCE)

resume: $(VENV)/.rig$(if $(call given,WORLD),-sim)  ## SESSION=sessions/x.zarr: continue a stopped session
	@$(TACTILE) collect --resume $(call quoted,$(call given,SESSION)) $(call options,AGAIN BENCH WORLD)

campaign: $(VENV)/.rig$(if $(call given,WORLD),-sim)  ## FILE=campaigns/day.yaml: record what is left of it
	@$(TACTILE) campaign $(call options,FILE OUT WORLD)

replay: $(VENV)/.rig  ## SESSION=sessions/x.zarr: play a session through mock hardware, record it again
	@$(TACTILE) replay $(call options,SESSION SPEED OUT)

##@ Demos on two cores, about ten minutes each
demo-learning: $(VENV)/.learning-sim  ## three simulated sensors, from press to report
	@$(TACTILE) sim archive $(DEMO)/array-hard.yaml,$(DEMO)/circle.yaml,$(DEMO)/diamond-soft.yaml $(SMALL) \
	  --out $(call folder,runs/demo-learning)/demo.markers.zarr
	@$(TACTILE) experiment $(call folder,runs/demo-learning)/demo.markers.zarr \
	  --out $(call folder,runs/demo-learning) --preset demo --pairs array-hard:circle,array-hard:diamond-soft

demo-transfer: $(VENV)/.learning-sim  ## newtons on a simulated sensor without a gauge
	@out=$(call folder,runs/demo-transfer) && bare="$$out/bare.markers.zarr:bare" && for name in gauge bare; do \
	  $(TACTILE) sim archive $(BARE)/$$name.yaml $(SMALL) --out "$$out/$$name.markers.zarr" || exit; done && \
	$(TACTILE) force --sensor "$$bare" --by source --source "$$out/gauge.markers.zarr" \
	  --ways mean,ridge,cells,kernel --out "$$out/model" && rm -rf "$$out/weighed" && \
	$(TACTILE) calibrate-force "$$out/model" $$($(PY) $(BARE)/weigh.py "$$bare" 200,400) \
	  --out "$$out/weighed" && $(TACTILE) evaluate "$$out/weighed" "$$bare"
demo-twin: $(VENV)/.rig-sim  ## a mock sensor is recorded and its twin identified
	@$(PY) -m benchmarks twin --only demo --out $(call folder,runs/twin-demo)/twin.md
demo-paper: $(VENV)/.learning-sim  ## the paper's training of its force net, at a quarter of the width
	@out=$(call folder,runs/demo-paper) && shown="$$out/demo.markers.zarr" && $(TACTILE) sim archive \
	  $(DEMO)/circle.yaml $(SMALL) --scale 0.05 --steps 1 --out "$$shown" && $(TACTILE) train force "$$shown" \
	  --preset examples/demo-paper/quarter.yaml --out "$$out/net" && $(TACTILE) evaluate "$$out/net" "$$shown"
demo-grasp: $(VENV)/.rig-learning-sim  ## SEED=7: simulated fingers lift 100 objects by force
	@$(TACTILE) grip --demo $(call options,SEED)

##@ Develop
test: $(VENV)/.rig-dev  ## run the default tests (about 6 minutes on 2 cores)
	@$(PY) -m pytest -q -n 3 --dist worksteal -m 'not serial'
	@$(PY) -m pytest -q -m serial

test-slow-sim: $(VENV)/.rig-dev  ## run slow tests of simulator and benchmarks (half an hour on 2 cores)
	@$(SLOW) -n 2 --dist worksteal -m 'slow and not serial' tests/sim tests/benchmarks

test-slow-rest: $(VENV)/.rig-dev  ## run the other slow tests, tutorials included (half an hour)
	@$(SLOW) -n 2 --dist worksteal -m 'slow and not serial' --ignore tests/sim --ignore tests/benchmarks
	@$(SLOW) -m 'slow and serial'

check: $(VENV)/.rig-dev  ## check lint, format, types, layers of imports, spelling, prose and docs
	@$(PY) -m ruff check . && $(PY) -m ruff format --check . && $(PY) -m mypy && $(VENV)/bin/codespell
	@$(VENV)/bin/lint-imports --no-logo && $(PY) tests/support/prose.py && $(MKDOCS) build

docs: $(VENV)/.docs  ## SERVE=1: show the documentation on a local page; without: build/docs
	@$(MKDOCS) $(if $(call given,SERVE),serve,build)

reference: $(VENV)/.rig  ## write docs/reference from the commands and packages
	@$(PY) tests/support/reference.py

format: $(VENV)/.rig-dev  ## format the code
	@$(PY) -m ruff format . && $(PY) -m ruff check --fix .

setup: $(VENV)/.rig  ## create the venv and install the dependencies of recording

clean:  ## remove the venv and caches, keep sessions
	rm -rf $(VENV) build *.egg-info .mypy_cache .pytest_cache .ruff_cache

$(PY):
	@$(if $(PYTHON),,uv --version >/dev/null || { echo "needs Python 3.12 or 3.11, or uv; or another Python" \
	  "and, to build ur-rtde, a C++ compiler, cmake and Boost: make PYTHON=python3.13"; exit 2; })
	@$(or $(if $(PYTHON),$(PYTHON) -m venv),uv venv --quiet --seed --python 3.12) $(VENV)
	@$(PIP) --upgrade pip

# The file .rig-sim says that the extras rig and sim are installed; those of development include all others.
$(VENV)/.%: pyproject.toml constraints.txt | $(PY)
	@echo "installing tactile-rig[$(subst -,$(comma),$*)] in $(VENV), once ..."
	@$(PIP) -e '.[$(subst -,$(comma),$*)]'
	@touch $@ $(addprefix $(VENV)/.,$(subst -, ,$*) $(if $(findstring dev,$*),$(ALL)))
