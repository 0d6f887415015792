# make setup | demo | test | test-all | lint.  Everything lives in .venv; PYTHON=python3.12 picks another Python.
VENV := .venv
PYTHON ?= python3
READY := $(VENV)/.ready
LINT_READY := $(VENV)/.lint-ready

# One test process a processor.
PARALLEL := -n logical --maxprocesses 8 --dist worksteal

.PHONY: setup demo test test-all lint

setup: $(READY)

$(READY): pyproject.toml scripts/setup.sh
	@bash scripts/setup.sh "$(PYTHON)" "$(VENV)"
	@touch $@

$(LINT_READY): $(READY)
	@$(VENV)/bin/python -m pip install --quiet --no-compile -e '.[lint]'
	@touch $@

demo: setup
	@$(VENV)/bin/mitsim demo -o demo-output

test: setup
	@$(VENV)/bin/python -m pytest -m 'not slow' $(PARALLEL)

test-all: setup
	@$(VENV)/bin/python -m pytest $(PARALLEL)

lint: $(LINT_READY)
	@$(VENV)/bin/ruff format --check .
	@$(VENV)/bin/ruff check .
	@$(VENV)/bin/mypy
