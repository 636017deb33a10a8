# The lab's front door: every target only calls `python -m ...`. `make` lists them.
SENSOR   ?= tacpalm
VENV     := .venv
PY       := $(VENV)/bin/python
PYTHON   ?= $(shell for p in python3.12 python3.11 python3; do \
              $$p -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' \
              2>/dev/null && echo $$p && break; done)
BENCHARG := $(if $(BENCH),--bench $(BENCH),--sensor $(SENSOR))
SOURCES  := $(if $(CAMERA),--camera $(CAMERA)) $(if $(STILL),--still) $(if $(TAXELS),--taxels $(TAXELS))
PIP      := $(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e

.PHONY: help collect resume preview compare mock check-session test test-all check format setup clean

help:  ## Show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## /{printf "  make %-14s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

collect: $(VENV)/.rig  ## Record one session: SENSOR=tacpalm [TARGETS=8] [INDENTER=cylinder] [OPERATOR=] [OUT=] [BENCH=file] [CAMERA=path [STILL=1]] [TAXELS=path] [TRUTH=file]
	@$(PY) -m rig collect $(BENCHARG) $(SOURCES) $(if $(TARGETS),--targets $(TARGETS)) \
	  $(if $(INDENTER),--indenter $(INDENTER)) $(if $(OUT),--out $(OUT)) $(if $(TRUTH),--truth $(TRUTH)) $(if $(OPERATOR),--operator $(OPERATOR))

resume: $(VENV)/.rig  ## Continue a stopped session: SESSION=sessions/x.zarr [BENCH=file]
	@$(PY) -m rig collect $(if $(BENCH),--bench $(BENCH)) $(SOURCES) --resume $(SESSION)

preview: $(VENV)/.rig  ## Draw the plan and check its limits: SENSOR=tacpalm [OUT=plan.png]
	@$(PY) -m rig preview $(BENCHARG) $(if $(OUT),--out $(OUT))

compare: $(VENV)/.rig  ## Hold a mock session against the World's truth: SESSION= TRUTH=
	@$(PY) -m rig compare --session $(SESSION) --truth $(TRUTH)

mock: $(VENV)/.rig  ## Run the emulators of a bench until Ctrl-C: SENSOR=tacpalm
	@$(PY) -m rig mock $(BENCHARG) $(SOURCES)

check-session: $(VENV)/.rig  ## Look for faults in a session: SESSION=sessions/x.zarr
	@$(PY) -m recorder check $(SESSION)

test: $(VENV)/.dev  ## Run the default tests (about 4 minutes on 2 cores)
	@$(PY) -m pytest -q

test-all: $(VENV)/.dev  ## Run all tests, the slow ones too
	@RUN_SLOW=1 $(PY) -m pytest -q --durations=10

check: $(VENV)/.dev  ## Lint, format check, types
	@$(PY) -m ruff check . && $(PY) -m ruff format --check . && $(PY) -m mypy

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

$(VENV)/.dev: pyproject.toml constraints.txt | $(VENV)/bin/python
	@$(PIP) '.[rig,dev]' && touch $@ $(VENV)/.rig
