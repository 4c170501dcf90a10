# The targets a user needs; `make` alone lists them.
.DEFAULT_GOAL := help
PYTHON ?= python3
BIN := .venv/bin

help:  ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## /\1: /p' Makefile

.venv/installed: pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@

install: .venv/installed  ## make the virtual environment .venv with everything in it

demo: .venv/installed  ## build a sphere and a snow grain, validate both, plot them into demo/
	mkdir -p demo
	$(BIN)/tsdf-build sphere --eta 1.33 --joint 32 --out demo/sphere.tsdf.exr
	$(BIN)/tsdf-build sphere --eta 1.333 --fresnel sp --out demo/zhou2003.tsdf.exr --quiet
	$(BIN)/tsdf-build snow --target-error 0.01 --joint 32 --out demo/snow.tsdf.exr
	$(BIN)/tsdf-plot demo/sphere.tsdf.exr --out demo/sphere.png
	$(BIN)/tsdf-plot demo/snow.tsdf.exr --out demo/snow.png
	$(BIN)/tsdf-validate demo/zhou2003.tsdf.exr --plot demo/zhou2003.png
	$(BIN)/tsdf-validate demo/sphere.tsdf.exr demo/snow.tsdf.exr
	@echo "tables and plots are in demo/"

test: .venv/installed  ## run the tests
	$(BIN)/python -m pytest

check: .venv/installed  ## style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: .venv/installed  ## measure speed and error side by side, into bench/
	$(BIN)/python benchmarks/bench.py

.PHONY: help install demo test check bench
