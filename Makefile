# Two commands do everything, set-up included: `make demo` and `make test`.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test test-long check docs site setup clean

demo: setup ## Train HalfCheetah on episodic rewards with recorded replies, and draw the report
	@if [ -e runs/demo ]; then $(BIN)/lare-rl train --resume runs/demo; \
	else $(BIN)/lare-rl train HalfCheetah-v4 --steps 60000 --out runs/demo; fi
	@$(BIN)/lare-rl report runs/demo

test: check ## Lint, format, types, tests
	$(BIN)/python -m pytest -n 2 --dist worksteal

test-long: setup ## The tests that repeat others with further algorithms, methods and tasks
	$(BIN)/python -m pytest -n 2 --dist worksteal -m long

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

docs: setup ## The documentation as a site, in site/, once every command and snippet in it has run
	$(BIN)/python -m pytest -n 2 --dist worksteal -m docs
	$(MAKE) site

site: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "to read it: $(BIN)/mkdocs serve, or open site/index.html"

setup: $(VENV)/installed

$(VENV)/installed: pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(None if sys.version_info >= (3, 11) else "LaRe needs Python 3.11 or later; name one: make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	@touch $@
	@echo "set up; to use it: source $(BIN)/activate"

clean:
	rm -rf $(VENV) site .pytest_cache .ruff_cache .hypothesis
