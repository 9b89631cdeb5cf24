# `make help` lists the targets. Each target sets up its own .venv from the pinned versions in requirements/dev.txt.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: help demo test nightly nightly-part lint docs gallery format lock wheel audit sbom clean

help:                       ## this list
	@awk -F ':.*## *' '/^[a-z-]+:.*##/ { printf "make %-12s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

.venv/.ready: requirements/dev.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit("tofuse needs Python 3.11 or newer, and $(PYTHON) is %s; try: make PYTHON=python3.12 ..." % sys.version.split()[0] if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements/dev.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@echo "compiling the numerical kernels on all cores, once: half a minute on two"
	-$(BIN)/python -c "from tofuse.engine.compute import ahead; ahead.compile_now()"
	@touch $@

demo: .venv/.ready          ## simulate a recording, reconstruct it, leave a model and a report in demo/
	$(BIN)/tofuse demo --out demo --overwrite

# Compiled modules are kept, even where the environment says otherwise: many tests start processes.
PYTEST = PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -q -n 2 --dist loadfile
# Rooms whose tests need no whole run: a first verdict within a minute.
FIRST = $(addprefix tests/,alignment cameras compute files filters geometry graph images noise poses sensor stored_views views)
test: .venv/.ready          ## run the tests of every change: the quick rooms, and if they pass the others, 6 minutes
	$(PYTEST) -m "not nightly and not nightly_part" $(FIRST)
	$(PYTEST) -m "not nightly and not nightly_part" tests $(addprefix --ignore=,$(FIRST))

nightly: .venv/.ready       ## run the other tests: long runs, clusters, killed processes, browsers, fuzzing, notebooks, real data
	$(PYTEST) -m "nightly or nightly_part"

nightly-part: .venv/.ready  ## run those of them that .ci/run takes as well, 2 minutes
	$(PYTEST) -m "nightly_part and not nightly"

lint: .venv/.ready          ## formatting, style, strict types, and who may import whom
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	PYTHONPATH=.ci $(BIN)/lint-imports
	$(BIN)/python requirements/check.py

gallery: .venv/.ready       ## simulate, reconstruct and draw the gallery of the documentation anew, some minutes
	$(BIN)/python website/gallery.py

.venv/.docs-ready: requirements/docs.txt .venv/.ready
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements/docs.txt
	@touch $@

docs: .venv/.docs-ready     ## the documentation site, in build/site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

format: .venv/.ready        ## put the code into its standard form
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# Versions and the hashes of all their files. What users install, with the extras but not the benchmarks' peers, is runtime.txt.
PIN = $(BIN)/uv pip compile --universal --python-version 3.11 --no-header --quiet --generate-hashes --upgrade
lock: .venv/.ready          ## pin the newest versions that pyproject.toml allows
	$(BIN)/python -m pip install --quiet uv
	$(PIN) --group dev pyproject.toml requirements/build.in -o requirements/dev.txt
	$(PIN) --group docs -c requirements/dev.txt -o requirements/docs.txt
	$(PIN) --extra dask --extra hdf5 --extra mcap --extra phones --extra rerun --extra ros --extra scan --extra texture --extra viewer pyproject.toml -c requirements/dev.txt -o requirements/runtime.txt
	$(PIN) --all-extras pyproject.toml -o requirements/extras.txt
	$(PIN) --group release -o requirements/release.txt

wheel: .venv/.ready         ## a wheel for this system and Python with the compiled kernels, in dist/
	HATCH_BUILD_HOOK_ENABLE_CUSTOM=true $(BIN)/python -m hatchling build --target wheel

build/release/.ready: requirements/release.txt
	$(PYTHON) -m venv build/release
	build/release/bin/python -m pip install --quiet --disable-pip-version-check -r requirements/release.txt
	@touch $@

audit: .venv/.ready build/release/.ready  ## look for known vulnerabilities of what is pinned
	$(BIN)/python requirements/check.py
	build/release/bin/pip-audit --disable-pip --require-hashes -r requirements/dev.txt
	build/release/bin/pip-audit --disable-pip --require-hashes -r requirements/runtime.txt

sbom: build/release/.ready  ## what a user installs, in CycloneDX: build/sbom.json
	rm -rf build/described
	$(PYTHON) -m venv --without-pip build/described
	build/release/bin/python -m pip --python build/described/bin/python install --quiet --disable-pip-version-check -r requirements/runtime.txt
	build/release/bin/cyclonedx-py environment --pyproject pyproject.toml --mc-type library --output-reproducible --of JSON -o build/sbom.json build/described/bin/python
	build/release/bin/python requirements/sbom.py build/sbom.json

clean:                      ## remove the environment and what was built
	rm -rf .venv build dist
