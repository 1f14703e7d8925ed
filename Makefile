# Every command sets itself up: `make test` in a fresh clone is enough.
# PYTHON chooses the interpreter (3.11 or newer) of the environments made here.

PYTHON ?= python3
JOBS ?= 2
PYTEST_ARGS ?=

BIN := .venv/bin
READY := .venv/.ready
DOCS_READY := .venv/.ready-docs
BENCH_READY := .venv-bench/.ready
AEON_READY := .venv-aeon/.ready
PINS_READY := .venv-pins/.ready

export PIP_DISABLE_PIP_VERSION_CHECK = 1
# Tests start many processes: without bytecode each would compile what it imports.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup hand lint types imports lines words unit test test-long benchmark peers peers-anew bench docs pictures pages notebooks format constraints clean distclean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-12s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

# A target named .ready appears only after everything before it has succeeded; an interrupted set-up starts again.
define make_environment
	rm -f $(1)/.ready
	$(1)/bin/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear $(1)
endef

$(READY): pyproject.toml constraints.txt
	$(call make_environment,.venv)
	$(BIN)/python -m pip install --quiet --no-input --no-compile -c constraints.txt -e ".[all,dev]"
	$(BIN)/python -m compileall -qq -j 0 .venv/lib || true # on all cores; a few files are of other Pythons
	touch $@

$(DOCS_READY): $(READY)
	$(BIN)/python -m pip install --quiet --no-input -c constraints.txt -e ".[docs]"
	touch $@

$(BENCH_READY): pyproject.toml benchmarks/requirements.txt benchmarks/constraints.txt
	$(call make_environment,.venv-bench)
	.venv-bench/bin/python -m pip install --quiet --no-input -c benchmarks/constraints.txt -r benchmarks/requirements.txt -e .
	touch $@

$(AEON_READY): benchmarks/requirements-aeon.txt benchmarks/constraints-aeon.txt
	$(call make_environment,.venv-aeon)
	.venv-aeon/bin/python -m pip install --quiet --no-input -c benchmarks/constraints-aeon.txt -r benchmarks/requirements-aeon.txt
	touch $@

$(PINS_READY): Makefile
	$(call make_environment,.venv-pins)
	.venv-pins/bin/python -m pip install --quiet --no-input "pip-tools>=7.4"
	touch $@

setup: $(READY) ## make .venv with pinned versions (the other targets do so by themselves)

hand: $(READY) ## also install what is used by hand: pre-commit, pytest-cov
	$(BIN)/python -m pip install --quiet --no-input -c constraints.txt -e ".[hand]"

lint: $(READY) ## ruff: rules and format
	$(BIN)/python -m ruff check
	$(BIN)/python -m ruff format --check

types: $(READY) ## mypy, strict
	$(BIN)/python -m mypy

imports: $(READY) ## import-linter: imports go one way
	$(BIN)/lint-imports

lines: $(READY) ## count lines and statements of every part
	@$(BIN)/python benchmarks/lines.py

words: $(READY) ## count the words of the documentation
	@$(BIN)/python benchmarks/words.py

unit: $(READY) ## the quick tests; PYTEST_ARGS="-k kalman" narrows them
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal --durations 10 -m "not long" $(PYTEST_ARGS)

test: lint types imports unit ## everything quick: lint, types, imports, tests; what CI runs

test-long: test ## the same and the tests marked long
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m long $(PYTEST_ARGS)

benchmark: $(READY) ## compare the classifiers; the report goes to out/benchmark
	$(BIN)/python -m motor_classifiers benchmark --peers benchmarks/results/peers.npz --out out/benchmark

peers: $(AEON_READY) ## make .venv-aeon, the environment of the generic classifiers

peers-anew: $(READY) $(AEON_READY) ## let them judge the benchmark's starts again; their answers are kept in benchmarks/results
	$(BIN)/python benchmarks/peers.py

bench: $(BENCH_READY) ## speed against peers, in an environment of its own; writes out/bench.json
	.venv-bench/bin/python benchmarks/run.py --out out/bench.json $(BENCH_ARGS)

docs: $(DOCS_READY) ## build the documentation into docs/_build/html and run its long pages; warnings are errors
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html
	$(BIN)/python -m pytest -q -n $(JOBS) --dist worksteal -m long tests/test_docs.py

pictures: $(READY) ## draw the screens and films of the documentation anew
	$(BIN)/python docs/make_pictures.py

pages: $(READY) ## write the pages of the environments anew
	$(BIN)/python docs/environment_pages.py

notebooks: $(DOCS_READY) ## run the notebooks of the documentation anew
	$(BIN)/python docs/make_notebooks.py

format: $(READY) ## let ruff format and fix what it can
	$(BIN)/python -m ruff format
	$(BIN)/python -m ruff check --fix

# Pins of every extra. Files from a local index carry a +cpu that others cannot find; the project itself is no pin.
# UPGRADE=--upgrade moves everything to the newest; without it only what changed in pyproject.toml moves.
PIP_COMPILE = .venv-pins/bin/python -m piptools compile --quiet --strip-extras --no-annotate --no-header \
	--no-emit-index-url --no-emit-find-links --no-emit-options $(UPGRADE)
CLEAN_PINS = sed -i.bak -E -e 's/\+cpu$$//' -e '/^motor-env( |$$)/d' -e '/^(\#|-e|$$)/d'

constraints: $(PINS_READY) ## pin all dependencies anew: constraints.txt and benchmarks/constraints.txt
	$(PIP_COMPILE) --all-extras -o constraints.txt pyproject.toml
	$(CLEAN_PINS) constraints.txt
	$(PIP_COMPILE) -c constraints.txt -o benchmarks/constraints.txt pyproject.toml benchmarks/requirements.txt
	$(CLEAN_PINS) benchmarks/constraints.txt
	rm -f constraints.txt.bak benchmarks/constraints.txt.bak

clean: ## remove caches and built files; out/ and the environments stay
	rm -rf build dist docs/_build docs/api .hypothesis .import_linter_cache .mypy_cache .pytest_cache .ruff_cache .coverage htmlcov
	find . -path './.venv*' -prune -o -name __pycache__ -type d -exec rm -rf {} +

distclean: clean ## the same and the environments
	rm -rf .venv .venv-aeon .venv-bench .venv-pins
