# `make train` and `make test` need nothing but Python (3.10 or later) and make.
PYTHON ?= python3
VENV ?= .venv
LOWEST ?= .venv-lowest
BIN := $(VENV)/bin
ALGO ?= sac_flow
ENV ?= TunnelDiagonal-v0
SEED ?= 1
LOGS ?= logs

.DEFAULT_GOAL := help
.PHONY: help train test docs lowest sb3-tests lint types check clean

help:  ## Show this help
	@grep -E '^[a-z0-9-]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-9s %s\n", $$1, $$2}'

# The stamp is remade only when the requirements change, so repeated calls start at once.
# Python compiles what it imports; compiling all of every package would take a minute more.
$(VENV)/.installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --no-compile --constraint constraints.txt --editable ".[all,dev]"
	touch $@

train: $(VENV)/.installed  ## Train ALGO on ENV with SEED, print the success rate, draw the policy
	$(BIN)/python -m rl_zoo3.train --algo $(ALGO) --env $(ENV) --seed $(SEED) --progress \
		--log-folder $(LOGS) --tensorboard-log $(LOGS)/tensorboard --eval-freq 2500 \
		--num-threads 1 --verbose 0
	$(BIN)/python -m sb3_flowpolicy.zoo.evaluate --algo $(ALGO) --env $(ENV) --folder $(LOGS)

test: $(VENV)/.installed  ## Run the tests
	$(BIN)/python -m pytest --numprocesses 2 --dist worksteal --durations 15

$(LOWEST)/.installed: pyproject.toml constraints-lowest.txt
	test -x $(LOWEST)/bin/python || $(PYTHON) -m venv $(LOWEST)
	$(LOWEST)/bin/pip install --quiet --no-compile --constraint constraints-lowest.txt \
		--editable ".[zoo,contrib]" pytest
	touch $@

lowest: $(LOWEST)/.installed  ## Run the smoke tests with the lowest versions allowed
	$(LOWEST)/bin/python -m pytest -m smoke tests/test_smoke.py

sb3-tests: $(VENV)/.installed  ## Run the SAC tests of the stable-baselines3 checkout SB3 with SACFlow
	$(BIN)/python tests/sb3_own_tests.py $(SB3)

$(VENV)/.docs-installed: $(VENV)/.installed
	$(BIN)/pip install --quiet --constraint constraints.txt --editable ".[docs]"
	touch $@

docs: $(VENV)/.docs-installed  ## Build the documentation in docs/_build/html
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet docs docs/_build/html

lint: $(VENV)/.installed  ## Check style
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.installed  ## Check types
	$(BIN)/mypy

check: lint types test  ## Everything that has to pass before a commit lands

clean:  ## Remove the virtual environments and caches
	rm -rf $(VENV) $(LOWEST) docs/_build .mypy_cache .pytest_cache .ruff_cache
