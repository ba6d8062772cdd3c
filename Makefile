# Needs only Python >= 3.11 with venv, and make.
PYTHON ?= python3
BIN := .venv/bin
# Test processes, each with one thread and about 1 GB. On two cores a third one uses the time that
# the others spend waiting for browsers, schedulers and processes that they start.
WORKERS ?= 3
# Examples of each kind that `make fuzz` tries.
EXAMPLES ?= 1000

.PHONY: setup run test test-newest fuzz mutants check shape site clean

setup: .venv/.installed

# Reinstalled only when the requirements change.
.venv/.installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test,check]'
	touch $@

run: setup
	$(BIN)/python -m mops_lightning

test: setup
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder

# The same with the newest versions that the requirements allow, in an environment of its own.
test-newest:
	test -x build/newest/bin/python || $(PYTHON) -m venv build/newest
	build/newest/bin/python -m pip install --quiet --upgrade --upgrade-strategy eager -e '.[test]'
	build/newest/bin/python -m pip list
	build/newest/bin/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder

# The long round of tests/fuzz; `make test` contains a short one.
fuzz: setup
	MOPS_FUZZ=$(EXAMPLES) $(BIN)/python -m pytest tests/fuzz -s

# Takes hours without MODULES="samplers/mops ops/readout".
mutants: setup
	OMP_NUM_THREADS=1 nice $(BIN)/mutmut run $(foreach module,$(MODULES),'mops_lightning.$(subst /,.,$(module)).*')
	$(BIN)/mutmut results

# The documentation as pages in build/site. Fails on any broken link.
site: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

check: setup site
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache
	$(BIN)/hadolint docker/*.Dockerfile

# How densely the code is written. Prints, never fails.
shape: setup
	$(BIN)/python -m tests.support.shape

clean:
	rm -rf .venv build dist mutants
