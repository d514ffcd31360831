# Two commands do everything: `make demo` and `make test`. The others are for working on dengine.
PYTHON ?= python3
VENV ?= .venv
# On a machine whose package index serves the CUDA build, name PyTorch's CPU index here:
#   make demo PIP_FLAGS="--extra-index-url <the CPU index from pytorch.org/get-started>"
PIP_FLAGS ?=
PIP = $(VENV)/bin/python -m pip install --quiet --progress-bar off --disable-pip-version-check --constraint constraints.txt $(PIP_FLAGS)
RUN = $(VENV)/bin/dengine
OUT ?= out
REPEATS ?= 200

.PHONY: setup demo test lint proof audit clean

setup: $(VENV)/.dev

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.demo: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(PIP) --no-compile --editable .
	touch $@

$(VENV)/.dev: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(PIP) --editable ".[dev]"
	touch $@ $(VENV)/.demo

demo: $(VENV)/.demo
	$(RUN) compare --data insertion --reducers conv,umap --alpha 0.1 --lower-bound 0.9 --repeats 1 --n-jobs 2 --out $(OUT)

test: $(VENV)/.dev
	$(VENV)/bin/python -m pytest --numprocesses 2 --dist loadfile

lint: $(VENV)/.dev
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

proof: $(VENV)/.dev
	DENGINE_PROOF_REPEATS=$(REPEATS) $(VENV)/bin/python -m pytest tests/statistical --numprocesses 2

audit: $(VENV)/.dev
	$(VENV)/bin/pip-audit --skip-editable

clean:
	rm -rf $(VENV) $(OUT) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
