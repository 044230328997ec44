# Two commands do all the set-up:  make demo   and   make test
# Needs Python 3.11 or later, make, and a package index for pip. Everything goes into .venv; nothing else on the machine is touched.

SHELL := /bin/bash
VENV ?= .venv
BIN := $(VENV)/bin
DEMO ?= demo-results
PAPER ?= paper-results
SITE ?= build/docs
WORKERS ?= 2
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check

# The first Python on the path that is new enough; `make PYTHON=/path/to/python …` chooses another.
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11 python; do \
	if $$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then echo $$p; break; fi; done)

# One file of tests stays in one process (--dist loadfile), so what its tests share is made once.
# Small matrices are slower with several BLAS threads; the tests run in $(WORKERS) processes instead.
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1
export MKL_NUM_THREADS := 1
export MPLBACKEND := Agg

.PHONY: help demo test lint types tests slow bench docs wheel example paper clean

help:
	@echo "make demo   install into $(VENV) and run the example, from raw files to the report in $(DEMO)/"
	@echo "make test   install what development needs and run ruff, mypy and the tests"
	@echo "make slow   the longer studies among the tests"
	@echo "make bench  speed and memory of the stages against their peers; fails where one falls short of its goal"
	@echo "make docs   build the documentation site into $(SITE)/; fails on any warning"
	@echo "make wheel  build dist/operando-*.whl"
	@echo "make example  make data/example again from benchmarks/example_data/make.py"
	@echo "make paper  reproduce the paper's simulation example: tables, figures and raw files through operando, in $(PAPER)/paper.html"
	@echo "make clean  remove the environment and what was built"

demo: $(VENV)/.installed
	$(BIN)/operando demo -o $(DEMO)
	@echo
	@echo "The report: $(abspath $(DEMO))/report.html"

test: lint types tests

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.installed-dev
	$(BIN)/mypy

tests: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -q -n $(WORKERS) --dist loadfile -m "not slow"

slow: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -q -n $(WORKERS) -m slow

bench: $(VENV)/.installed-dev
	$(BIN)/python benchmarks/bench.py

docs: $(VENV)/.installed-docs
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs $(SITE)
	$(BIN)/python docs/check_links.py $(SITE)
	@echo
	@echo "The site: $(abspath $(SITE))/index.html"

wheel: $(VENV)/.installed
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir dist .

example: $(VENV)/.installed
	$(BIN)/python benchmarks/example_data/make.py

paper: $(VENV)/.installed
	$(BIN)/python benchmarks/paper/reproduce.py $(PAPER)

clean:
	rm -rf $(VENV) $(DEMO) $(PAPER) build dist .pytest_cache .ruff_cache .mypy_cache

# Stamps: a second call installs nothing as long as pyproject.toml is unchanged.
$(VENV)/bin/python:
	@test -n "$(PYTHON)" || { echo "operando needs Python 3.11 or later; none was found. Name it: make PYTHON=/path/to/python3.11 demo" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml | $(VENV)/bin/python
	$(PIP) --editable .
	@touch $@

$(VENV)/.installed-docs: pyproject.toml | $(VENV)/bin/python
	$(PIP) --editable ".[docs]"
	@touch $(VENV)/.installed $@

$(VENV)/.installed-dev: pyproject.toml | $(VENV)/bin/python
	$(PIP) --editable ".[dev]"
	@touch $(VENV)/.installed $@
