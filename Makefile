# Every target makes what it needs: on a machine with Python 3.11 to 3.13 and a C compiler,
# `make demo` and `make test` work in a fresh clone. A second call installs nothing.
#
#   make demo       the ice varves, from the model to its posterior
#   make test       format, lint, types, tests
#   make slow       the long statistical checks
#   make exhaustive the same with whole tables and very long chains: hours
#   make gap        the blind benchmark of the diagnosis: of 24 sets what three minutes allow
#   make tables     the tables of unbiasedness at full length, over an hour
#   make examples   run what is under examples/
#   make check      the examples against statsmodels, hmmlearn and particles
#   make docs       the documentation, notebooks executed, warnings are errors, links within it checked
#   make linkcheck  the links of the documentation to other sites; needs the network
#   make bench      speed against plain C and other packages
#   make package    sdist and wheel, installed and used under every Python and set of dependencies
#   make audit      known vulnerabilities of the dependencies
#   make format     put the code into shape
#   make clean      remove what the build made (the environment stays)
#
# PYTHON=... chooses the interpreter, VENV=... the environment, WORKERS=... the parallel tests;
# PACKAGE=... and AUDIT=... are options of those two (PACKAGE=--help lists them).

PYTHON  ?= $(firstword $(foreach p,python3.11 python3.12 python3.13 python3,$(shell command -v $(p) 2>/dev/null)))
VENV    ?= .venv
WORKERS ?= 2
BIN     := $(VENV)/bin
PIP     := $(BIN)/python -m pip install --quiet --disable-pip-version-check

export MPLBACKEND ?= Agg
# With as many workers as cores a second thread of linear algebra in each only waits for a core.
test slow exhaustive tables gap examples docs: export OPENBLAS_NUM_THREADS ?= 1

.DEFAULT_GOAL := help
.PHONY: help demo test slow exhaustive tables gap examples check docs linkcheck bench package audit
.PHONY: format clean

help:
	@sed -n 's/^#   //p' Makefile

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "no Python found: install Python 3.11, or say PYTHON=/path/to/python3.11"; exit 1; }
	$(PYTHON) -c 'import sys; ok = (3, 11) <= sys.version_info[:2] < (3, 14); sys.exit(0 if ok else "ssmppl needs Python 3.11 to 3.13; say PYTHON=/path/to/python3.11")'
	$(PYTHON) -m venv $(VENV)

# One stamp per set of packages; the package itself is installed in place.
$(VENV)/.installed-run: pyproject.toml | $(BIN)/python
	$(PIP) --editable .
	@touch $@

$(VENV)/.installed-dev: pyproject.toml | $(BIN)/python
	$(PIP) --editable '.[dev]'
	@touch $@ $(VENV)/.installed-run

$(VENV)/.installed-check: pyproject.toml | $(BIN)/python
	$(PIP) --editable '.[check]'
	@touch $@ $(VENV)/.installed-run

$(VENV)/.installed-docs: pyproject.toml | $(BIN)/python
	$(PIP) --editable '.[docs]'
	@touch $@ $(VENV)/.installed-run

demo: $(VENV)/.installed-run
	$(BIN)/ssmppl demo

test: $(VENV)/.installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -q -n $(WORKERS) --dist worksteal

slow: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -q -n $(WORKERS) --dist worksteal -m 'slow and not exhaustive' \
	    --durations 40 --durations-min 20

exhaustive: $(VENV)/.installed-dev
	SSMPPL_SBC_SETS=100 $(BIN)/python -m pytest -q -n $(WORKERS) --dist worksteal \
	    -m 'exhaustive or slow' --durations 40

tables: $(VENV)/.installed-dev
	SSMPPL_TABLE_REPEATS=2000 $(BIN)/python -m pytest -s -m 'slow or exhaustive' -k table -n $(WORKERS) \
	    tests/statistics/test_likelihood.py

gap: $(VENV)/.installed-dev
	$(BIN)/python -m bench.gap.generate --subset ci
	$(BIN)/python -m bench.gap.run --subset ci --mode fast --workers $(WORKERS) --minutes 3
	$(BIN)/python -m bench.gap.score --subset ci --methods diagnose-fast \
	    --require failed "false alarm"

examples: $(VENV)/.installed-run
	@mkdir -p build
	printf '%s\n' $(sort $(wildcard examples/*/run.py)) | xargs -n 1 -P $(WORKERS) -t $(BIN)/python
	$(BIN)/ssmppl explain examples/heating/model.py examples/heating/data.csv
	$(BIN)/ssmppl sample examples/heating/model.py examples/heating/data.csv --draws 500 --seed 1 \
	    -o build/heating.nc

check: $(VENV)/.installed-check
	$(BIN)/python -m examples.check

docs: $(VENV)/.installed-docs
	$(BIN)/python -m sphinx -T -W --keep-going -j $(WORKERS) -b html docs docs/_build/html
	$(BIN)/python docs/check_built.py docs/_build/html

linkcheck: $(VENV)/.installed-docs
	$(BIN)/python -m sphinx -D nb_execution_mode=off -b linkcheck docs docs/_build/linkcheck

bench: $(VENV)/.installed-dev
	$(BIN)/python bench/run.py

package: $(BIN)/python
	$(BIN)/python -m tests.packaging --workers $(WORKERS) $(PACKAGE)

audit: $(BIN)/python
	$(BIN)/python -m tests.packaging.audit $(AUDIT)

format: $(VENV)/.installed-dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:
	rm -rf build dist docs/_build docs/generated bench/build .mypy_cache .pytest_cache .ruff_cache
	find ssmppl tests docs -name __pycache__ -type d -prune -exec rm -rf {} +
