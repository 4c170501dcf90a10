# The targets a user needs; `make` alone lists them.
.DEFAULT_GOAL := help
PYTHON ?= python3
BIN := .venv/bin

help:  ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## /\1: /p' Makefile

.venv/installed: pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[dev]'
	$(BIN)/python -m compileall -q tsdf cli loaders schema reference_data  # as pip does with what it copies
	@touch $@

install: .venv/installed  ## make the virtual environment .venv with everything in it

demo: .venv/installed  ## tables of two kinds, plotted and validated, and one small picture at two levels, into demo/
	@echo "make demo: two tables and the published sphere (15 s), their plots and validation (10 s), glass beads grain by"
	@echo "grain and by teleportation, kernels compiled first (45 s on two cores). make gallery has everything else."
	mkdir -p demo
	$(BIN)/tsdf-build sphere --eta 1.5 --joint 32 --memory 64 --out demo/glass.tsdf.exr
	$(BIN)/tsdf-build snow --paths 1e6 --out demo/grain.tsdf.exr
	$(BIN)/tsdf-build sphere --eta 1.333 --fresnel sp --out demo/zhou2003.tsdf.exr --quiet
	$(BIN)/tsdf-plot demo/glass.tsdf.exr --out demo/glass.png
	$(BIN)/tsdf-plot demo/grain.tsdf.exr --out demo/grain.png
	$(BIN)/tsdf-validate demo/glass.tsdf.exr demo/grain.tsdf.exr
	$(BIN)/tsdf-validate demo/zhou2003.tsdf.exr --plot demo/zhou2003.png
	$(BIN)/python scenes/make_assets.py
	for level in explicit teleport-memory; do \
		$(BIN)/tsdf-render scenes/beads.toml --level $$level --out demo/beads_$$level.exr --width 320 --spp 128 || exit; done
	$(BIN)/python scenes/side_by_side.py demo/beads_explicit.exr demo/beads_teleport-memory.exr demo/beads.png
	@echo "look at demo/*.png: glass and grain (tables), zhou2003 (a published curve), beads (two levels)"

tables: .venv/installed  ## build the tables that the scenes name, into demo/
	mkdir -p demo
	$(BIN)/tsdf-build sphere --eta 1.5 --joint 32 --memory 64 --out demo/glass.tsdf.exr --quiet
	$(BIN)/tsdf-build sphere --eta 1.33 --joint 32 --memory 64 --out demo/sphere.tsdf.exr --quiet
	$(BIN)/tsdf-build snow --target-error 0.01 --joint 32 --memory 64 --out demo/snow.tsdf.exr
	$(BIN)/tsdf-build sand --material quartz --target-error 0.02 --joint 32 --memory 64 --out demo/sand.tsdf.exr
	$(BIN)/tsdf-build ellipsoid --set subdivisions=4 --material quartz --target-error 0.02 --joint 32 --memory 64 --out demo/clear.tsdf.exr
	$(BIN)/tsdf-validate demo/glass.tsdf.exr demo/sphere.tsdf.exr demo/snow.tsdf.exr demo/sand.tsdf.exr demo/clear.tsdf.exr

library: .venv/installed  ## make the ready tables of the package and their page again, to the same bytes
	$(BIN)/python -m tsdf.reference_data.make_library

stress: .venv/installed  ## measure where methods fail, and make docs/stress.md and its picture of it
	$(BIN)/tsdf-stress --out stress
	cp stress/stress.md stress/stress.svg docs/

gallery: tables  ## the scenes large and the chart of errors, into gallery/; SECONDS=900 is the time for each picture
	mkdir -p gallery
	$(BIN)/tsdf-plot demo/snow.tsdf.exr --out gallery/snow.png
	$(BIN)/tsdf-accuracy demo/sphere.tsdf.exr --out gallery/accuracy --seconds 300 --quiet
	for name in coarse-snow fresh-snow glass-beads plates quartz salt sand sugar; do \
		$(BIN)/tsdf-preview $$name --out gallery/$$name.png --quiet || exit; done
	$(MAKE) --no-print-directory pictures INTO=gallery WIDTH=1280 STOP="--seconds $(or $(SECONDS),900)"

pictures: .venv/installed
	$(BIN)/python scenes/make_assets.py
	$(BIN)/tsdf-render scenes/snow.toml --out $(INTO)/snow_heap.exr --width $(WIDTH) $(STOP)
	$(BIN)/tsdf-render scenes/sand.toml --out $(INTO)/sand_dune.exr --width $(WIDTH) $(STOP)
	for level in explicit teleport-memory teleport; do \
		$(BIN)/tsdf-render scenes/beads.toml --level $$level --out $(INTO)/beads_$$level.exr --width $(WIDTH) \
			$(STOP) || exit; done
	$(BIN)/python scenes/side_by_side.py $(INTO)/beads_explicit.exr $(INTO)/beads_teleport-memory.exr \
		$(INTO)/beads_teleport.exr $(INTO)/beads.png
	$(BIN)/python scenes/plate.py $(INTO)/snow_heap.png $(INTO)/sand_dune.png $(INTO)/beads_explicit.png $(INTO)/scenes.png

JOBS ?= 2
PYTEST := $(BIN)/python -m pytest --numprocesses $(JOBS) --dist loadfile

test: .venv/installed  ## run the tests, in two processes; JOBS=4 for more
	$(PYTEST)

test-fast: .venv/installed  ## run the tests but those that take long
	$(PYTEST) -m "not slow"

check: .venv/installed  ## style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: .venv/installed  ## make the API reference, into reference/
	$(BIN)/python docs/reference.py
	@echo "open reference/index.html; docs/index.md lists all pages"

frontier: .venv/installed  ## measure error against processor time in seven scenes, and of building, into frontier/; 40 minutes
	mkdir -p frontier
	$(BIN)/tsdf-frontier scenes/frontier/dilute.toml scenes/frontier/dense.toml scenes/frontier/thin.toml \
		scenes/frontier/deep.toml scenes/frontier/close.toml scenes/frontier/mixture.toml scenes/frontier/buried.toml \
		--out frontier $(if $(SECONDS),--seconds $(SECONDS))
	$(BIN)/python benchmarks/bench_building.py sphere --out frontier
	@echo "docs/frontier.md reads the charts aloud; benchmarks/bench_peers.py puts other renderers on them"

bench: .venv/installed  ## measure speed and error side by side, into bench/
	$(BIN)/python benchmarks/bench.py
	$(BIN)/python benchmarks/bench_sampler.py
	$(BIN)/python benchmarks/bench_render.py
	$(BIN)/python benchmarks/bench_mitsuba.py

FUZZERS := tables meshes scenes pictures builds signals

fuzz: .venv/installed  ## throw damaged and hostile files and signals at everything, for minutes; COUNT=1000 SEED=1
	for name in $(FUZZERS); do \
		$(BIN)/python fuzz/$$name.py $(if $(COUNT),--count $(COUNT)) --seed $(or $(SEED),0) || exit; done

.PHONY: help install demo tables library stress frontier gallery pictures test test-fast check docs bench fuzz
