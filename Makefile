# make demo       fit a transfer function on a generated mesh; pictures and a report in output/demo
# make test       lint, then all tests (sets up everything it needs)
# make quick      lint, then the tests that touch every room, in two minutes
# make pythons    the same tests with the other Pythons that are found, oldest and newest JAX
# make lint       ruff and pyright only
# make docs       the documentation as a site, in output/site
# make notebooks  run the notebooks and keep their pictures
# make venv       the environment with all development tools, in .venv
# make clean      remove the environment, caches and outputs
#
# PYTHON picks the interpreter (3.11 or newer):  make test PYTHON=python3.12
# PINS are requirements beside the project's:    make test PINS="jax==0.7 jaxlib==0.7"

PYTHON ?= python3
PINS ?=
VENV := .venv
BIN := $(VENV)/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet

.DELETE_ON_ERROR:
.PHONY: demo test quick pythons lint ruff pyright tests-all tests-rooms docs notebooks venv clean

demo: $(VENV)/.package
	$(BIN)/python -m experiments.demo --out output/demo

# Nearly all the time of the tests goes into compiling, and most of them ask what is computed, not
# how it is rounded: those do without LLVM's optimiser. The rest is compiled as it is for users.
TESTS = $(BIN)/python -m pytest -n 2 --dist loadscope --no-loadscope-reorder
UNOPTIMISED = XLA_FLAGS="--xla_backend_optimization_level=0 $$XLA_FLAGS"

# Pyright has one core busy for most of a minute, so tests run meanwhile. Both are waited for, and
# either that fails makes these targets fail.
test: ruff
	$(MAKE) --no-print-directory -j 2 pyright tests-all

quick: ruff
	$(MAKE) --no-print-directory -j 2 pyright tests-rooms

tests-all: $(VENV)/.tools
	$(UNOPTIMISED) $(TESTS) -m "not optimised"
	$(TESTS) -m optimised

tests-rooms: $(VENV)/.tools
	$(UNOPTIMISED) $(TESTS) -m rooms

pythons:
	$(PYTHON) .ci/pythons.py

lint: ruff pyright

ruff: $(VENV)/.tools
	$(BIN)/ruff check .

pyright: $(VENV)/.tools
	$(BIN)/pyright

docs: $(VENV)/.docs
	$(BIN)/python -m notebooks.site
	$(BIN)/mkdocs build --strict --quiet --config-file .mkdocs.yml

notebooks: $(VENV)/.docs
	$(BIN)/python -m notebooks.run

venv: $(VENV)/.tools

# Each stamp is older than pyproject.toml when that has changed, and the installation is then redone.
# Byte code is left to the first import of a module: most of what is installed is never imported.
INSTALL = $(PIP) install --no-compile --editable

$(VENV)/.made:
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(v < (3, 11) and "jaxvr needs Python 3.11 or newer, but %s is %d.%d: pass PYTHON=..." % (sys.executable, *v[:2]))'
	@echo "Setting up $(VENV) ..."
	$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/.package: pyproject.toml | $(VENV)/.made
	$(INSTALL) .
	@touch $@

$(VENV)/.tools: pyproject.toml | $(VENV)/.made
	$(INSTALL) '.[dev]' $(PINS)
	@touch $@

$(VENV)/.docs: pyproject.toml | $(VENV)/.made
	$(INSTALL) '.[docs,notebooks,peers]'
	@touch $@

clean:
	rm -rf $(VENV) $(VENV)-* output dist .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
