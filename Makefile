# make run | test | lint | bench | results | soak | clean        (GNU make, Python 3.11 or later; everything goes into .venv)
PYTHON ?= python3
INPUT  ?= scenarios/signals_red_light.toml
ARGS   ?=

VENV  := .venv
BIN   := $(VENV)/bin
STAMP := $(VENV)/.installed

# One pytest process per core, up to four. A file's tests stay together, since they share what its fixtures ran.
PARALLEL := -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder
# The tests start the program hundreds of times, and it starts faster from bytecode.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: run test lint bench results soak clean
.DEFAULT_GOAL := run

run: $(STAMP)
	$(BIN)/python -m sumo_adv run $(INPUT) --until serious --force $(ARGS)

test: lint
	$(BIN)/python -m pytest -m "not soak" $(PARALLEL) $(ARGS)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/mypy benchmarks
	$(BIN)/python docs/check_prose.py

bench: $(STAMP)
	@status=0; for script in $(filter-out %/golden.py %/conformance_scenes.py %/results.py $(wildcard benchmarks/transformer*.py),$(wildcard benchmarks/*.py)); do echo "== $$script"; $(BIN)/python $$script $(ARGS) || status=1; done; exit $$status

results: $(STAMP)
	$(BIN)/python benchmarks/results.py $(ARGS)

# Real engines and servers, in no other test: what does not install here is said, and its tests skip.
SOAKED := "ray>=2.40" xllamacpp gguf

soak: $(STAMP)
	@for package in $(SOAKED); do $(BIN)/python -m pip install --quiet --disable-pip-version-check "$$package" -c constraints.txt || \
	  echo "make soak: $$package does not install here; its tests are skipped." >&2; done
	$(BIN)/python -m pytest -m soak $(ARGS)

clean:
	rm -rf build dist .pytest_cache .hypothesis .mypy_cache .ruff_cache *.egg-info
	find sumo_adv tests examples networks -name __pycache__ -type d -prune -exec rm -rf {} +

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "sumo_adv needs Python 3.11 or later as $(PYTHON): install one and say make PYTHON=python3.11." >&2; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || \
	  { echo "$(PYTHON) cannot make virtual environments: install the package python3-venv (apt-get install python3-venv)." >&2; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[dev]" -c constraints.txt
	@touch $(STAMP)
