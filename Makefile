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

demo: .venv/installed  ## build tables, validate and plot them, render the scenes small, all into demo/
	mkdir -p demo
	$(BIN)/tsdf-build sphere --eta 1.33 --joint 32 --memory 64 --out demo/sphere.tsdf.exr
	$(BIN)/tsdf-build sphere --eta 1.333 --fresnel sp --out demo/zhou2003.tsdf.exr --quiet
	$(BIN)/tsdf-build snow --target-error 0.01 --joint 32 --memory 64 --out demo/snow.tsdf.exr
	$(BIN)/tsdf-build sand --material quartz --target-error 0.02 --joint 32 --memory 64 --out demo/sand.tsdf.exr --quiet
	$(BIN)/tsdf-build ellipsoid --set subdivisions=4 --material quartz --target-error 0.02 --joint 32 --memory 64 --out demo/clear.tsdf.exr --quiet
	$(BIN)/tsdf-build sphere --eta 1.5 --joint 32 --memory 64 --out demo/glass.tsdf.exr --quiet
	$(BIN)/tsdf-plot demo/sphere.tsdf.exr --out demo/sphere.png
	$(BIN)/tsdf-plot demo/snow.tsdf.exr --out demo/snow.png
	$(BIN)/tsdf-validate demo/zhou2003.tsdf.exr --plot demo/zhou2003.png
	$(BIN)/tsdf-validate demo/sphere.tsdf.exr demo/snow.tsdf.exr demo/sand.tsdf.exr demo/clear.tsdf.exr demo/glass.tsdf.exr
	$(BIN)/tsdf-accuracy demo/sphere.tsdf.exr --out demo/accuracy --seconds 60 --quiet
	$(MAKE) --no-print-directory pictures INTO=demo WIDTH=320
	@echo "tables, plots and pictures are in demo/"

gallery: demo  ## render the scenes large into gallery/; SECONDS=900 is the time for each picture
	mkdir -p gallery
	$(MAKE) --no-print-directory pictures INTO=gallery WIDTH=1280 STOP="--seconds $(or $(SECONDS),900)"

pictures:
	$(BIN)/python scenes/make_assets.py
	$(BIN)/tsdf-render scenes/snow.toml --out $(INTO)/snow_heap.exr --width $(WIDTH) $(STOP)
	$(BIN)/tsdf-render scenes/sand.toml --out $(INTO)/sand_dune.exr --width $(WIDTH) $(STOP)
	for level in explicit teleport-memory teleport; do \
		$(BIN)/tsdf-render scenes/beads.toml --level $$level --out $(INTO)/beads_$$level.exr --width $(WIDTH) \
			$(STOP) || exit; done
	$(BIN)/python scenes/side_by_side.py $(INTO)/beads_explicit.exr $(INTO)/beads_teleport-memory.exr \
		$(INTO)/beads_teleport.exr $(INTO)/beads.png
	$(BIN)/python scenes/plate.py $(INTO)/snow_heap.png $(INTO)/sand_dune.png $(INTO)/beads_explicit.png $(INTO)/scenes.png

test: .venv/installed  ## run the tests
	$(BIN)/python -m pytest

check: .venv/installed  ## style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: .venv/installed  ## measure speed and error side by side, into bench/
	$(BIN)/python benchmarks/bench.py
	$(BIN)/python benchmarks/bench_sampler.py
	$(BIN)/python benchmarks/bench_render.py

.PHONY: help install demo gallery pictures test check bench
