# make setup | learn | demo | paper | test | test-all | lint | docs | figures | robustness | mutants | wheel.  Everything
# lives in .venv; PYTHON=python3.12 picks another Python.
VENV := .venv
PYTHON ?= python3
READY := $(VENV)/.ready
LINT_READY := $(VENV)/.lint-ready
DOCS_READY := $(VENV)/.docs-ready
LEARN_READY := $(VENV)/.learn-ready
INSTALL := $(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --no-compile

# Byte code is written also where the environment says not to: the suite starts some sixty programs, each of which would
# compile all that it imports, for a second or more.
test test-all robustness: export PYTHONDONTWRITEBYTECODE :=
# One thread of BLAS in a test process: more would wait, busily, on the processors of the other test processes.
test test-all robustness: export OMP_NUM_THREADS := 1

# One test process a processor.
PARALLEL := -n logical --maxprocesses 8 --dist worksteal

.PHONY: setup learn demo paper test test-all lint docs figures robustness mutants wheel

setup: $(READY)

$(READY): pyproject.toml scripts/setup.sh
	@bash scripts/setup.sh "$(PYTHON)" "$(VENV)"
	@touch $@

$(LINT_READY): $(READY)
	@$(INSTALL) -e '.[lint]'
	@touch $@

$(DOCS_READY): $(READY)
	@$(INSTALL) -e '.[docs]'
	@touch $@

# PyTorch, without which networks and their tests are left out: 5.7 GB.
learn: $(LEARN_READY)

$(LEARN_READY): $(READY)
	@$(INSTALL) -e '.[learn]'
	@touch $@

demo: setup
	@$(VENV)/bin/mitsim demo -o demo-output

# Every experiment of the paper and beyond it, on one page; goes on where it stopped.
paper: setup
	@$(VENV)/bin/mitsim study all -o paper-output

test: setup
	@$(VENV)/bin/python -m pytest -m 'not slow' $(PARALLEL)

test-all: setup
	@$(VENV)/bin/python -m pytest $(PARALLEL)

lint: $(LINT_READY)
	@$(VENV)/bin/ruff format --check .
	@$(VENV)/bin/ruff check .
	@$(VENV)/bin/mypy
	@$(VENV)/bin/vulture

# Warnings are errors; nothing is fetched and no notebook is run.
docs: $(DOCS_READY)
	@$(VENV)/bin/python -m sphinx -q -W --keep-going -b html -c docs . docs/_build/html
	@echo docs/_build/html/index.html

# The figures that pages state, README's pictures and all drawings, by mitsim's own commands: five minutes.
figures: setup
	@$(VENV)/bin/python docs/figures.py

# All figures of docs/robustness.md anew, by all tests that are marked with `robustness`.
robustness: setup
	@rm -f docs/_build/robustness.json
	@$(VENV)/bin/python -m pytest -m robustness $(PARALLEL) --robustness=docs/robustness.md

# Planted bugs that the quick tests must see; not part of any test run.
mutants: learn
	@$(VENV)/bin/python benchmarks/mutants.py

wheel: setup
	@rm -rf dist
	@$(VENV)/bin/python -m pip wheel --quiet --disable-pip-version-check --no-deps -w dist .
	@ls dist/mitsim-*.whl
