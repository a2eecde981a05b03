# Everything here makes its own environment in .venv; nothing else need be installed but Python.
PYTHON ?= python3
# On Linux, PyPI's torch is the CUDA build; pip finds the CPU build with
#   make demo PIP_FLAGS="--extra-index-url https://download.pytorch.org/whl/cpu"
PIP_FLAGS ?=
BIN := .venv/bin
PIP ?= $(BIN)/pip
# Files of tests side by side, one per core; a file stays whole, so that what its tests share is made
# once. One thread each, or the workers' linear algebra fights over the cores. Compiled modules are
# kept: every command that a test starts would compile them again, and every worker the tests.
PYTEST := OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n auto --dist loadfile --durations 30

.PHONY: demo test test-slow torture lint types docs wheel clean

demo: .venv/base  ## Set up and run the main job end to end on simulated logs.
	$(BIN)/ucfrec demo --out demo-out

test: .venv/dev  ## Set up and run the tests, all but the slow ones.
	$(PYTEST) -m "not slow"

test-slow: .venv/dev  ## The slow tests: trainings and simulations that take many seconds each.
	$(PYTEST) --dist worksteal -m slow $$(grep -rl --include "test_*.py" mark.slow tests)

# SCALE is a share of the cases.
SCALE ?= 1
torture: .venv/dev  ## Kill, interrupt, corrupt, fuzz and starve the commands, or (MUTANTS=1) broken ones.
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.torture --scale $(SCALE) $(if $(MUTANTS),--mutants)

lint: .venv/dev  ## Style.
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: .venv/dev  ## Types, strict.
	$(BIN)/mypy
	$(BIN)/mypy examples/*.py benchmarks/*.py

docs: .venv/docs  ## Build the pages into build/docs; a broken link or reference fails.
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

wheel: .venv/dev  ## Build the wheel into dist/.
	$(BIN)/hatchling build -t wheel

.venv/base: pyproject.toml constraints.txt
	@echo "Setting up .venv: downloads torch and some twenty packages, a few minutes"
	$(PYTHON) -m venv .venv
	$(PIP) install $(PIP_FLAGS) -c constraints.txt -e .
	touch $@

.venv/dev: .venv/base
	$(PIP) install $(PIP_FLAGS) -c constraints.txt -e ".[control,dev]"
	touch $@

.venv/docs: .venv/base
	$(PIP) install $(PIP_FLAGS) -c constraints.txt -e ".[docs]"
	touch $@

clean:
	rm -rf .venv dist build demo-out
