# `make demo` and `make test` each work as the very first command on a fresh machine.
# Some tests, and other options of pytest: make test TESTS='tests/test_lens.py --durations=3', or in PYTEST_ADDOPTS.
# Two files are tested at a time. In one process, for a debugger: make test WORKERS=0
# Another interpreter: make demo PYTHON=python3.12. Another build of PyTorch: make demo TORCH='torch==2.13.0 ...'.

PYTHON ?= python3
TORCH ?= torch==2.13.0
TESTS ?= tests
WORKERS ?= 2

BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check

.DELETE_ON_ERROR:
.PHONY: help demo test check format bench package site clean

help:
	@echo 'make demo    photographs to a film and a report in a few minutes'
	@echo 'make test    all tests'
	@echo 'make check   formatting, lint, types, tests'
	@echo 'make format  let the formatter have its way'
	@echo 'make bench   throughput of every kernel on every engine'
	@echo 'make package a wheel and a source archive, in dist/'
	@echo 'make site    the documents as a site, in site/'
	@echo 'make clean   remove the virtual environment and all caches'

demo: .venv/.installed
	$(BIN)/lumigraph demo

test: .venv/.tools
	PYTEST_ADDOPTS="--durations=10 $$PYTEST_ADDOPTS" $(BIN)/python -m pytest -q -n $(WORKERS) --dist loadfile --no-loadscope-reorder $(TESTS)

check: .venv/.tools
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(MAKE) --no-print-directory test

format: .venv/.tools
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: .venv/.installed
	$(BIN)/lumigraph bench kernels

package: .venv/.made
	$(PIP) build
	$(BIN)/python -m build --outdir dist .

site: .venv/.tools
	$(BIN)/python docs/site_pages.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict

clean:
	rm -rf .venv .pytest_cache .mypy_cache .ruff_cache build dist site *.egg-info
	find lumigraph tests -name __pycache__ -prune -exec rm -rf {} +

# Stamps: each step of the installation is done once, and again when pyproject.toml changes.

.venv/.made:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { echo \
	"Lumigraph needs Python 3.11 or newer, and $(PYTHON) is $$($(PYTHON) --version 2>/dev/null || echo missing). \
	Name another one: make $(MAKECMDGOALS) PYTHON=python3.12" >&2; exit 1; }
	$(PYTHON) -m venv .venv
	@touch $@

.venv/.torch: .venv/.made
	@echo 'Installing PyTorch ...'
	$(PIP) '$(TORCH)'
	@touch $@

.venv/.installed: .venv/.torch pyproject.toml
	@echo 'Installing Lumigraph ...'
	$(PIP) --editable .
	@touch $@

.venv/.tools: .venv/.installed
	@echo 'Installing the tools for tests ...'
	$(PIP) --editable '.[dev]'
	@touch $@
