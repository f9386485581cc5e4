# Two commands do everything, set-up included: `make demo` and `make test`.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
CONSTRAINTS ?= constraints.txt
DEMO := runs/demo
# Python may keep compiled modules: without them, each process takes some ten seconds to import JAX and this package.
unexport PYTHONDONTWRITEBYTECODE

PINS := $(addprefix --constraint ,$(CONSTRAINTS))
ifneq ($(shell command -v uv),)
CREATE := uv venv --quiet --seed --python $(PYTHON) $(VENV)
INSTALL := uv pip install --quiet --python $(BIN)/python $(PINS)
else
CREATE := $(PYTHON) -m venv $(VENV)
INSTALL := $(BIN)/python -m pip install --quiet --no-compile $(PINS)
endif

.PHONY: demo test test-short test-families test-long check docs site setup constraints clean

demo: $(VENV)/demo ## Train Reacher on episodic rewards with recorded replies, draw the report, open it
	@if [ -e $(DEMO) ]; then $(BIN)/lare-rl train --resume $(DEMO); \
	else $(BIN)/lare-rl train Reacher-v4 --steps 30000 --out $(DEMO); fi
	@$(BIN)/lare-rl report $(DEMO)
	@if [ -n "$$DISPLAY$$WAYLAND_DISPLAY" ] || [ "$$(uname)" = Darwin ]; \
	then $(BIN)/python -m webbrowser "file://$$PWD/$(DEMO)/report.html"; \
	else echo "to see it, open $(DEMO)/report.html in a browser"; fi

test: check ## Lint, format, types, tests
	$(BIN)/python -m pytest -n 2 --dist worksteal

test-short: $(VENV)/test ## Some of the tests, with little installed
	$(BIN)/python -m pytest -n 2 --dist worksteal tests/config tests/data tests/envs/test_gymnasium_env.py tests/envs/test_mujoco_warnings.py \
		tests/latent tests/report tests/runs tests/test_cli.py tests/training/test_train.py

test-families: $(VENV)/families ## The tests of gymnax and JaxMARL, which need an older Gymnasium: in a VENV of their own, with CONSTRAINTS=
	$(BIN)/python -m pytest -n 2 --dist worksteal tests/envs/test_gymnax_env.py tests/envs/test_jaxmarl_env.py tests/envs/test_jax_families.py

test-long: setup ## Slow tests, and those that repeat others with further algorithms, methods and tasks
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

$(VENV)/installed: pyproject.toml $(CONSTRAINTS) | $(BIN)/python
	$(INSTALL) 'pip>=25.1' # the first that reads dependency groups
	$(INSTALL) --editable . --group dev
	@touch $(VENV)/demo $(VENV)/test $@
	@echo "set up; to use it: source $(BIN)/activate"

$(VENV)/test: pyproject.toml $(CONSTRAINTS) | $(BIN)/python
	$(INSTALL) 'pip>=25.1'
	$(INSTALL) --editable . --group test
	@touch $(VENV)/demo $@

$(VENV)/families: pyproject.toml | $(BIN)/python
	$(INSTALL) 'pip>=25.1'
	$(INSTALL) --editable '.[gymnax,jaxmarl]' --group test
	@touch $@

$(VENV)/demo: pyproject.toml $(CONSTRAINTS) | $(BIN)/python
	$(INSTALL) --editable '.[mujoco,report]'
	@touch $@

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit(None if sys.version_info >= (3, 11) else "LaRe needs Python 3.11 or later; name one: make PYTHON=python3.12")'
	$(CREATE)

constraints: ## Write the newest versions that fit into constraints.txt (needs uv)
	echo "--editable ." | uv pip compile - --quiet --universal --python-version 3.11 --group dev --upgrade --no-annotate \
		--no-emit-package lare-rl --custom-compile-command "make constraints" --output-file constraints.txt

clean:
	rm -rf $(VENV) $(VENV)-* site .pytest_cache .ruff_cache .hypothesis
