# Two commands for a first user: `make demo` and `make test`. Both set up what they need.
# The simulator, pybullet, has wheels up to Python 3.11 and for x86-64 alone.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
# What is installed: `make EXTRA=test test` leaves out the simulator and skips the tests that need it.
EXTRA ?= dev
VENV := .venv
BIN := $(VENV)/bin
AUDIT := $(VENV)/audit
STAMP := $(VENV)/.installed-$(EXTRA)
# Python compiles a module when it is first imported. Compiling all of them doubles the time of the installation.
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt

# Compiles what runs often where it is not compiled yet: no robot and no test waits for it.
COMPILE := $(BIN)/python -c 'import mapweave.agent.runner; from mapweave.hybridmap import jit; jit.load()'

# pytest keeps what it has read of the tests, and Hypothesis the constants of all modules, once a property has run: else
# each of pytest's processes reads all of them anew the first time.
READ_TESTS := $(BIN)/python -m pytest -k test_an_edge_keeps_its_content > /dev/null 2>&1

.PHONY: setup demo test check docs bench slow slow-waits slow-most scenarios sbom audit audit-tools clean

setup: $(STAMP)

# Without its package for environments Debian's Python leaves one without pip, which is completed once that is there.
$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Mapweave needs Python 3.11 or newer; try: make PYTHON=python3.11 $(MAKECMDGOALS)"; exit 1; }
	@$(BIN)/python -m pip --version > /dev/null 2>&1 || $(PYTHON) -m venv $(VENV)
	@echo "installing into $(VENV), 2 GB (a minute or two) ..."
ifeq ($(EXTRA),dev)
	@$(PIP) --only-binary :all: pybullet 2>$(VENV)/pip.log || grep -q "connection broken" $(VENV)/pip.log || \
	  ! grep -q "No matching distribution" $(VENV)/pip.log || \
	  echo "there is no wheel of pybullet for $$($(BIN)/python -V) on $$(uname -m): compiling it takes ten minutes" \
	  "or more; with python3.11 on x86-64 it takes seconds, and make EXTRA=test does without the simulator"
endif
	@$(PIP) -e '.[$(EXTRA)]'
	@$(READ_TESTS) & $(COMPILE); status=$$?; wait; exit $$status
	@touch $(STAMP)

demo: setup
	$(BIN)/mapweave demo

# Three workers more than cores, five at the most: many tests wait for processes. Each takes up to 1 GB.
# `make test WORKERS=0` is one process.
WORKERS ?= $(shell expr $$(getconf _NPROCESSORS_ONLN) + 3)
test: setup
	@$(COMPILE)
	$(BIN)/python -m pytest -m "not slow and not scenario" -n $(WORKERS) --maxprocesses 5 --dist worksteal

# The files that have tests of a mark: to read all takes six seconds of processor time.
marked = $$(grep -rl --include='*.py' 'mark\.$1\b' tests)

slow: setup $(AUDIT)/.installed
	@$(COMPILE)
	@$(MAKE) --no-print-directory -j 2 slow-waits slow-most
	$(BIN)/python -m pytest -m "slow and alone" $(call marked,alone)

# Beside three workers: these wait for time-outs, or drive in real time, and need half a core at most.
slow-waits:
	$(BIN)/python -m pytest -m "slow and waits" $(call marked,waits)

slow-most:
	$(BIN)/python -m pytest -m "slow and not alone and not waits" -n 3 --dist worksteal

# About three quarters of an hour on two cores: every scenario, in real processes, and the longest tests.
scenarios: setup
	$(BIN)/python -m pytest -m scenario -rA --durations=0

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The pages as a site, in out/site; a broken link is an error.
docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

# The tools of `make sbom` and `make audit`, and axe-core for the page's tests, without the browsers that its package would
# bring. Apart from all else: what the tools bring for checking addresses takes 1.6 s to import, and each process of a
# Ray cluster would import it.
$(AUDIT)/.installed: constraints.txt | $(STAMP)
	@$(BIN)/python -m venv $(AUDIT)
	@$(AUDIT)/bin/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt \
	  cyclonedx-bom pip-audit
	@$(AUDIT)/bin/python -m pip install --quiet --disable-pip-version-check --no-compile --no-deps -c constraints.txt \
	  axe-playwright-python || echo "axe-core cannot be installed: the tests of the page by its rules are skipped"
	@touch $@

audit-tools: $(AUDIT)/.installed

# What Mapweave is installed with, exactly, as CycloneDX: the same file each time.
SBOM := out/sbom.json
sbom: $(AUDIT)/.installed
	@mkdir -p $(dir $(SBOM))
	@$(AUDIT)/bin/cyclonedx-py requirements constraints.txt --pyproject pyproject.toml --output-reproducible --no-validate \
	  --of JSON -o $(SBOM)
	@echo "written: $(SBOM)"

# Known vulnerabilities of these versions, by the advisories of PyPI. One that cannot be looked up is an error.
audit: $(AUDIT)/.installed
	@$(AUDIT)/bin/pip-audit --strict --no-deps --disable-pip --progress-spinner off -r constraints.txt \
	  > $(AUDIT)/found 2> $(AUDIT)/said && echo "no known vulnerabilities" || { cat $(AUDIT)/found; test -s $(AUDIT)/found || \
	  echo "the advisories of PyPI cannot be looked up: $$(tail -n 1 $(AUDIT)/said | cut -c 1-200)"; exit 1; }

bench: setup
	@for b in $$(dirname benchmarks/*/__main__.py); do \
	  echo "== $$(basename $$b)"; $(BIN)/python -m benchmarks.$$(basename $$b); done

clean:
	rm -rf $(VENV) out .mypy_cache .ruff_cache .pytest_cache
