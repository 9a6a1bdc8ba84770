# `make` alone lists the targets.

PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
# Empty: the sweep of the package, music_rllib/sweep/default.yaml.
CONFIG ?=
PYTEST_ARGS ?=
SECONDS ?= 600
SEED    ?= 0
# The tests of a file stay together and share what they set up; tests/conftest.py orders the files.
# Three keep two cores busy, because sweeps wait for their processes. Unit tests do not wait.
JOBS   ?= 3
PYTEST = $(BIN)/python -m pytest -n $(JOBS) --dist loadscope --no-loadscope-reorder

export PIP_DISABLE_PIP_VERSION_CHECK := 1
# If it is set, each process of a sweep compiles all modules of the package again: 0.7 s.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help venv sweep test test-unit test-faults fuzz lint type bench profile results docs clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo
	@echo "  PYTHON=python3.12    the interpreter for the virtual environment (>= 3.11)"
	@echo "  CONFIG=my.yaml       another sweep for 'make sweep'"
	@echo "  PYTEST_ARGS='-k q'   more arguments for pytest"
	@echo "  JOBS=4               number of simultaneous tests (default $(JOBS); each may use two cores)"

venv: $(STAMP)  ## create .venv and install everything, once
ifeq ($(origin PYTHON),command line)
	@[ "$$($(BIN)/python -V)" = "$$("$(PYTHON)" -V)" ] || \
	  { echo "$(VENV) has $$($(BIN)/python -V); for '$(PYTHON)' add VENV=.venv-other." >&2; exit 1; }
endif

# Install torch first: with its exact version in place, the second, much larger resolution cannot
# try other builds of it, each of which is a download of gigabytes.
$(STAMP): pyproject.toml constraints.txt
	@command -v "$(PYTHON)" >/dev/null || \
	  { echo "'$(PYTHON)' was not found. Install Python >= 3.11, or run 'make $(MAKECMDGOALS) PYTHON=/path/to/python'." >&2; exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "music_rllib needs Python >= 3.11; '$(PYTHON)' is $$("$(PYTHON)" -V 2>&1). Run 'make $(MAKECMDGOALS) PYTHON=/path/to/python'." >&2; exit 1; }
	@"$(PYTHON)" -c 'import venv, ensurepip' 2>/dev/null || \
	  { echo "'$(PYTHON)' has no venv module (on Debian and Ubuntu: apt-get install python3-venv)." >&2; exit 1; }
	@echo "[1/4] creating $(VENV) with $$("$(PYTHON)" -V 2>&1)"
	@"$(PYTHON)" -m venv "$(VENV)"
	@echo "[2/4] installing torch"
	@$(BIN)/python -m pip install -qq -c constraints.txt torch
	@echo "[3/4] installing Ray, MuJoCo, MLflow and the rest (a few minutes)"
	@$(BIN)/python -m pip install -qq -c constraints.txt -e '.[dev]'
	@echo "[4/4] compiling the updates of the packaged sweep (a minute)"
	@folder=$$(mktemp -d); \
	  $(BIN)/python -m music_rllib plan --measure --storage "$$folder" >/dev/null || \
	  echo "They could not be compiled now; the first run will compile them." >&2; rm -rf "$$folder"
	@touch $@
	@echo "$(VENV) is ready"

sweep: venv  ## train the packaged sweep and write its report (minutes)
	@$(BIN)/python -m music_rllib.sweep $(CONFIG)

test: venv  ## run the whole suite (CI=true: a missing service is a failure, not a skip)
	@$(PYTEST) $(PYTEST_ARGS)

test-unit: JOBS = 2
test-unit: venv  ## run the unit tests (about a minute)
	@$(PYTEST) tests/unit $(PYTEST_ARGS)

test-faults: venv  ## inject faults and compare with uninterrupted runs (15 minutes)
	@$(PYTEST) -m 'faults or thorough' $(PYTEST_ARGS)

fuzz: venv  ## change policies, exports and YAML at random and read them (SECONDS=600 SEED=0)
	@$(BIN)/python -m tests.fuzz --seconds $(SECONDS) --seed $(SEED)

lint: venv  ## check rules, formatting (ruff) and imports between sub-packages (import-linter)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/lint-imports

type: venv  ## check types (mypy --strict)
	@$(BIN)/mypy

bench: venv  ## measure all costs as ratios in one run (BENCH='step environment': some of them)
	@$(BIN)/python -m pip install -qq -c constraints.txt -e '.[bench]'
	@$(BIN)/python -m benchmarks $(BENCH)

profile: venv  ## write a flame graph of a training run to results/profile.svg
	@$(BIN)/python -m benchmarks.profile

results: venv  ## rebuild the results pages, their figures and the README picture
	@$(BIN)/python -m docs.generate_results

docs: venv  ## build the documentation site in build/docs, with search; open its index.html
	@rm -rf build/docs
	@$(BIN)/python docs/build_site.py build/docs
	@echo "open build/docs/index.html"

clean:  ## remove caches and build output (keeps .venv and results)
	@rm -rf build dist *.egg-info .pytest_cache .hypothesis .mypy_cache .ruff_cache
	@find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +
