# make demo     watch the shipped model servo the arm on a table it has never seen
# make test     lint, types and tests
# make bench    measure speed against the plain ways of doing the same
# All of them need nothing before them but Python 3.10 to 3.12 and system OpenGL (EGL or OSMesa).

# The first that is of the right age and can make virtual environments; or say: make PYTHON=/path/to/python3.11
RIGHT_AGE := import ensurepip, sys; sys.exit(not (3, 10) <= sys.version_info < (3, 13))
PYTHON ?= $(shell for name in python3 python3.11 python3.12 python3.10; do \
	$$name -c '$(RIGHT_AGE)' 2>/dev/null && echo $$name && break; done)
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
DEMO := build/demo
PACKAGES := envs data_collection worldmodel planning

.PHONY: setup demo test lint bench clean

setup: $(INSTALLED)

$(INSTALLED): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "error: no Python 3.10 to 3.12 with venv here; install one (on Debian: apt-get" \
	  "install python3 python3-venv python3-dev), or say where it is: make PYTHON=/path/to/python3.11" >&2; exit 2; }
	@echo "installing into $(VENV): takes some minutes the first time"
	@test -x $(BIN)/pip || $(PYTHON) -m venv --upgrade-deps $(VENV) # Python's own pip takes longer
	$(BIN)/python -m pip install -qq --no-compile --constraint constraints.txt --editable '.[dev]'
	@$(BIN)/python -m compileall -qq -j 0 -x '/tests?/' $(VENV)/lib $(PACKAGES) || true # on all cores, which pip cannot do
	@touch $@

demo: setup
	@rm -rf $(DEMO) && mkdir -p $(DEMO)
	$(BIN)/check-rendering
	$(BIN)/servo-eval --model t3vip --episodes 5 --scene D --out $(DEMO) --video 2
	$(BIN)/collect-rollouts --env tabletop --scene D --episodes 1 --seed 7 --workers 1 --ground-truth --out $(DEMO)/data
	$(BIN)/view-prediction --models t3vip --data $(DEMO)/data --out $(DEMO)/prediction.png $(DEMO)/prediction.mp4
	@echo "report      $(DEMO)/servo.json, $(DEMO)/success.png"
	@for video in $(DEMO)/videos/*.mp4; do echo "video       $$video"; done
	@echo "prediction  $(DEMO)/prediction.png, $(DEMO)/prediction.mp4"

test: lint # four processes even on two cores: they wait much of their time, for others that tests start
	$(BIN)/python -m pytest --numprocesses 4 --dist loadfile --no-loadscope-reorder

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy --num-workers 2

bench: setup
	$(BIN)/python -m tests.benchmarks --out build/bench.json

clean:
	rm -rf build .pytest_cache .mypy_cache .ruff_cache .hypothesis
