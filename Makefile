# `make` alone lists what there is.

PYTHON ?= $(or $(shell command -v python3.11),python3)
# In the order of tests/conftest.py, not by each file's number of tests.
PYTEST_ARGS ?= -n 2 --dist loadfile --no-loadscope-reorder
DEMO_OUT ?= runs/demo

# Material for MkDocs tells of its successor in each run.
export NO_MKDOCS_2_WARNING := 1

VENV := .venv
BIN := $(VENV)/bin
PIP_INSTALL := $(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt

.DEFAULT_GOAL := help
.PHONY: help setup setup-all demo test test-slow lint docs docs-serve dist-check clean
.DELETE_ON_ERROR:

help: ## list the targets
	@grep -E '^[a-z-]+:.*##' $(firstword $(MAKEFILE_LIST)) | sed -E 's/:.*## /\t/' | expand -t 12

setup: $(VENV)/.setup ## install the toolkit, simulators, planner and what the tests need into .venv

setup-all: $(VENV)/.setup-all ## add the windows for teaching and annotating, with their Debian libraries

demo: setup ## learn peg-in-hole from one demonstration and write a report
	$(BIN)/sart run peg_in_hole --out $(DEMO_OUT)
	@echo "The report: $(DEMO_OUT)/report.html"

# One thread a test process: two processes already fill two cores, and torch's threads would
# wait for each other.
test: setup-all ## run the tests (PYTEST_ARGS="-k name" for some of them)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m "not slow" $(PYTEST_ARGS)

test-slow: setup-all ## run the tests that take minutes
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m slow $(PYTEST_ARGS)

lint: setup ## check style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Not --quiet: warnings that aren't printed aren't errors either.
docs: $(VENV)/.setup-docs ## build the documentation into site/; a bad link is an error
	$(BIN)/mkdocs build

docs-serve: $(VENV)/.setup-docs ## show the documentation in a browser, and what changes in it
	$(BIN)/mkdocs serve

dist-check: setup ## build wheel and sdist, and run each in an empty environment
	$(BIN)/python tools/check_wheel.py

clean: ## remove .venv, caches and build products, but not runs/
	rm -rf $(VENV) build dist site *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/.setup: pyproject.toml constraints.txt tools/setup_debian.sh
	@groups="core sapien"; \
	    $(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || groups="python $$groups"; \
	    bash tools/setup_debian.sh $$groups
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' || { \
	    echo "sart_toolkit needs Python 3.11 to 3.13, but '$(PYTHON) --version' says:" \
	        "$$($(PYTHON) --version 2>&1). Type: make $(MAKECMDGOALS)" \
	        "PYTHON=/path/to/python3.11" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(PIP_INSTALL) -e '.[dev,sapien,planning,ray,formats,gym,calibrate,modbus]'
	@touch $@

$(VENV)/.setup-docs: $(VENV)/.setup
	$(PIP_INSTALL) -e '.[docs]'
	@touch $@

$(VENV)/.setup-all: $(VENV)/.setup tools/setup_debian.sh
	bash tools/setup_debian.sh annotate teleop
	$(PIP_INSTALL) -e '.[dev,sapien,planning,ray,formats,gym,calibrate,modbus,teleop,annotate,web]'
	@touch $@
