# Needs only Python >= 3.11 with venv, and make.
PYTHON ?= python3
BIN := .venv/bin
# Test processes, each with one thread and about 1 GB.
WORKERS ?= 2

.PHONY: setup run test check clean

setup: .venv/.installed

# Reinstalled only when the requirements change.
.venv/.installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test,check]'
	touch $@

run: setup
	$(BIN)/python -m mops_lightning

test: setup
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache
	$(BIN)/hadolint docker/*.Dockerfile

clean:
	rm -rf .venv build dist
