# Everything here makes its own environment in .venv; nothing else need be installed but Python.
PYTHON ?= python3
# Outside a machine with the CPU wheel at hand, pip finds CPU builds of torch with
#   make demo PIP_FLAGS="--extra-index-url https://download.pytorch.org/whl/cpu"
PIP_FLAGS ?=
BIN := .venv/bin

.PHONY: demo test lint types docs wheel clean

demo: .venv/base  ## Set up and run the main job end to end on simulated logs.
	$(BIN)/ucfrec demo --out demo-out

test: .venv/dev  ## Set up and run the tests.
	$(BIN)/python -m pytest

lint: .venv/dev  ## Style.
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: .venv/dev  ## Types, strict.
	$(BIN)/mypy

docs: .venv/docs  ## Build the pages into build/docs; a broken link or reference fails.
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

wheel: .venv/dev  ## Build the wheel into dist/.
	$(BIN)/hatchling build -t wheel

.venv/base: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install -q $(PIP_FLAGS) -c constraints.txt -e .
	touch $@

.venv/dev: .venv/base
	$(BIN)/pip install -q $(PIP_FLAGS) -c constraints.txt -e ".[control,dev]"
	touch $@

.venv/docs: .venv/base
	$(BIN)/pip install -q $(PIP_FLAGS) -c constraints.txt -e ".[docs]"
	touch $@

clean:
	rm -rf .venv dist build demo-out
