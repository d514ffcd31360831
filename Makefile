# Two commands to begin with: `make demo` and `make test`. The others are for working on dengine.
PYTHON ?= python3
VENV ?= .venv
# On a machine whose package index serves the CUDA build, name PyTorch's CPU index here:
#   make demo PIP_FLAGS="--extra-index-url <the CPU index from pytorch.org/get-started>"
PIP_FLAGS ?=
PIP = $(VENV)/bin/python -m pip install --quiet --progress-bar off --disable-pip-version-check --constraint constraints.txt $(PIP_FLAGS)
RUN = $(VENV)/bin/dengine
PYTEST = $(VENV)/bin/python -m pytest --numprocesses 3 --dist loadgroup --no-loadscope-reorder
OUT ?= out
AUDIT = $(VENV)/audit
# At least so many packages must have been audited; the run-time dependencies alone are more.
AUDITED = 30

define COUNT_AUDITED
import json, pathlib, sys
path = pathlib.Path(sys.argv[1])
least = int(sys.argv[2])
packages = json.loads(path.read_text())["dependencies"] if path.exists() else []
audited = [package for package in packages if "skip_reason" not in package]
flaws = [(package, flaw) for package in audited for flaw in package["vulns"]]
for package, flaw in flaws:
    versions = ", ".join(flaw["fix_versions"]) or "no version yet"
    print(package["name"], package["version"], flaw["id"], "fixed in:", versions)
print(f"Audited {len(audited)} packages, found {len(flaws)} vulnerabilities; expected at least {least} packages.")
sys.exit(len(audited) < least or bool(flaws))
endef
export COUNT_AUDITED

define LOCKED
import json, sys
packages = json.load(sys.stdin)["install"]
for package in sorted(packages, key=lambda package: package["metadata"]["name"].lower()):
    metadata = package["metadata"]
    hashes = package["download_info"].get("archive_info", {}).get("hashes")
    if "+" in metadata["version"]:
        sys.exit(f"The public index has no {metadata['name']} {metadata['version']}.")
    if hashes:
        print(f"{metadata['name']}=={metadata['version']} --hash=sha256:{hashes['sha256']}")
endef
export LOCKED
REPEATS ?= 200
# A hundred processes import the same modules: they are compiled once.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: setup demo test test-merge test-ci test-all lint docs proof evidence audit dist clean

setup: $(VENV)/.dev

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.demo: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(PIP) --no-compile --editable ".[serve,files,mcap]"
	touch $@

$(VENV)/.dev: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(PIP) --no-compile --editable ".[dev]"
	@# Two processes compile what pip would compile in one. Some file of a package may be for another version of Python.
	@$(VENV)/bin/python -m compileall -qq --workers 2 -x '/tests/|/torch/testing/_internal/' $(VENV)/lib || true
	touch $@ $(VENV)/.demo

demo: $(VENV)/.demo
	$(RUN) compare --data insertion --reducers conv,umap --alpha 0.1 --lower-bound 0.9 --repeats 1 --n-jobs 2 --out $(OUT) --force
	@echo 'Go on with:  . $(VENV)/bin/activate && dengine run --cycles 600 --alpha 0.1 --lower-bound 0.9 --store demo.db'

test: $(VENV)/.dev
	$(PYTEST) -m "not slow" tests/unit tests/contract tests/e2e tests/golden

# The slow tests that each merge must pass; a PostgreSQL server is named by DENGINE_TEST_POSTGRES (.ci/postgres.sh).
test-merge: $(VENV)/.dev
	$(PYTEST) -m merge

# `test` and `test-merge` in one go, whose workers start, import and collect once.
test-ci: $(VENV)/.dev
	$(PYTEST) -m "not slow or merge"

# Everything: each page and notebook, umap-learn, fuzzing, outages, statistics.
test-all: $(VENV)/.dev
	$(PYTEST)

lint: $(VENV)/.dev
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/lint-imports --no-cache --no-logo

# Into site/, warnings are errors. Read it with `python -m http.server --directory site`.
docs: $(VENV)/.dev
	$(VENV)/bin/python -m mkdocs build --strict

proof: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(VENV)/bin/python -m tests.slow.proof --out $(OUT)/proof --repeats $(REPEATS) --jobs 2
	cp $(OUT)/proof/proof.csv docs/explanation/
	OMP_NUM_THREADS=1 $(VENV)/bin/python -m tests.slow.proof.engine --out $(OUT)/engine --docs docs/explanation --jobs 2
	OMP_NUM_THREADS=1 $(VENV)/bin/python -m tests.slow.proof.null --out $(OUT)/null --docs docs/explanation

# All figures of the documentation, at one commit: some fourteen hours, in parts that continue where they were killed. SCREW names the
# screw-driving set, an .npz file; . .ci/postgres.sh starts the server that the faults need.
evidence: $(VENV)/.dev
	$(VENV)/bin/python training/make_evidence.py --out $(OUT)/all_evidence $(if $(SCREW),--screw $(SCREW))
	$(VENV)/bin/python training/make_evidence.py --out $(OUT)/all_evidence --publish
	$(VENV)/bin/python training/list_figures.py

# pip-audit may skip every package and still end well, so what it audited is counted. It gets names and plain versions: one
# that is installed in editable form, or a build like 2.9.0+cpu, is not on PyPI, and --strict fails at what is not there.
audit: $(VENV)/.dev
	@rm -f $(AUDIT).json
	@$(VENV)/bin/python -m pip list --format freeze --exclude-editable | sed 's/+[^ ]*//' > $(AUDIT).txt
	@$(VENV)/bin/pip-audit --strict --no-deps --disable-pip --requirement $(AUDIT).txt --format json --output $(AUDIT).json || true
	@$(VENV)/bin/python -c "$$COUNT_AUDITED" $(AUDIT).json $(AUDITED)

# For a project of one's own: a wheel and an sdist; and what they need with these extras, with versions and hashes, for this
# version of Python and this system. `===` takes the public index's build of PyTorch, which is found on every machine, and not
# one like 2.13.0+cpu. An old pip downloads all of it, with CUDA's libraries.
EXTRAS = serve,files,mcap,onnx,postgres,opcua,sim,dask
dist: $(VENV)/.dev
	rm -rf dist
	$(VENV)/bin/python -m build --no-isolation > /dev/null
	$(PIP) --dry-run --ignore-installed --report - ".[$(EXTRAS)]" "$$(sed -n 's/^torch==/torch===/p' constraints.txt)" \
		| $(VENV)/bin/python -c "$$LOCKED" > dist/requirements.lock
	@ls dist

clean:
	rm -rf $(VENV) $(OUT) build dist site *.egg-info .pytest_cache .mypy_cache .ruff_cache
