# make demo | test | check | bench : each sets up .venv first, from the pinned and hashed set.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
PEERS := $(VENV)/peers

.PHONY: demo test check bench setup peers kernels pins clean

demo: $(STAMP)
	$(BIN)/terranav demo --out terranav-demo

test: $(STAMP)
	@$(MAKE) --no-print-directory --jobs=2 check peers kernels
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 2  # two workers share two cores

check: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports
	$(BIN)/mypy

bench: $(STAMP)
	$(BIN)/python -m benchmarks

setup: $(STAMP)

$(STAMP): requirements/dev.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "terranav needs Python 3.11 or newer: make PYTHON=python3.12 ..."; exit 2; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/dev.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	touch $@

# Programs that tests fly with, in a folder of their own; without them their tests are skipped, and say so.
peers: $(STAMP)
	@test $(PEERS)/.installed -nt requirements/peers.txt || { rm -rf $(PEERS) && $(BIN)/python -m pip install --quiet --disable-pip-version-check --retries 1 --timeout 20 --no-deps --no-compile --require-hashes --target $(PEERS) -r requirements/peers.txt && touch $(PEERS)/.installed; } || echo "peers: not installed, their tests are skipped"

# The demo compiles kernels that most tests use: once, while types are checked, and not by each worker.
kernels: $(STAMP)
	@$(BIN)/terranav demo --out $(VENV)/demo > /dev/null

pins:
	uv pip compile --quiet --no-deps --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-emit-find-links --no-header requirements/peers.in -o requirements/peers.txt
	uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-emit-find-links --no-header --extra dev requirements/build.in pyproject.toml -o requirements/dev.txt

clean:
	rm -rf $(VENV) terranav-demo
