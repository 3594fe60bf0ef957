# Two commands do everything: `make demo` and `make test`; each sets up what is missing first.
PYTHON ?= python3
VENV := .venv
# More BLAS threads do not speed up matrices this small; they only take the other core from the simulator.
export OPENBLAS_NUM_THREADS := 1
# Memory of images that is given back is kept for the next: the kernel would clear each page of it again.
export MALLOC_MMAP_THRESHOLD_ := 1073741824
export MALLOC_TRIM_THRESHOLD_ := 1073741824
# Tests start some hundred programs: each would compile the sources again where keeping bytecode is switched off.
export PYTHONDONTWRITEBYTECODE :=
BIN := $(VENV)/bin
# Tests wait two thirds of their time, for real clocks and other processes.
WORKERS := $(shell workers=$$(($$(nproc) * 3)); echo $$((workers < 12 ? workers : 12)))
# MB that pyright's new objects may take: its garbage is collected less often, which saves 4 % of its processor time.
CHECKER_OPTIONS := --max-semi-space-size=128
# Pyright runs on the Node.js that is installed with it: an older one of the system takes a fifth more processor time.
export PYRIGHT_PYTHON_GLOBAL_NODE := 0
RUNTIME_PACKAGES := libaravis-0.8-0 libusb-1.0-0
PEER_PACKAGES := aravis-tools-cli aravis-tools chromium-headless-shell/chromium gcc libc6-dev

.PHONY: setup demo test nightly bench benchmark clean

setup: $(VENV)/installed
	@sh .ci/system-packages $(RUNTIME_PACKAGES)

demo: setup
	$(BIN)/stand demo

test: setup
	@sh .ci/system-packages $(PEER_PACKAGES)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports
	@NODE_OPTIONS=$(CHECKER_OPTIONS) $(BIN)/pyright & types=$$!; $(BIN)/pytest -n $(WORKERS); tests=$$?; \
		wait $$types || { echo "pyright has found errors, see above"; exit 1; }; exit $$tests

nightly: setup
	@sh .ci/system-packages $(PEER_PACKAGES) spin
	$(BIN)/pytest -m "nightly or hypothesis" --hypothesis-profile=nightly -o faulthandler_timeout=5400
	$(BIN)/python -m tests.torture --minutes 30 --jobs $(shell nproc) --shrink 40
	$(BIN)/python -m tests.torture --real --minutes 10 --jobs $(shell nproc)

bench: setup
	$(BIN)/python -m tests.bench

# METHOD=my_method.py scores one more, see docs/explanation/benchmark.md.
benchmark: setup
	$(BIN)/python -m tests.benchmark $(METHOD)

$(VENV)/installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "thermostand needs Python 3.11 or newer; name it with: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || sh .ci/system-packages python3-venv
	$(PYTHON) -m venv $(VENV)
	@echo "installing into $(VENV); this takes some minutes"
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev,peers]'
	@touch $@

clean:
	rm -rf $(VENV) demo demo-*
