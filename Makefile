# make data train eval    the whole line on the embedded default; any combination works
# make data train eval SYSTEM=NAME    the same of another system
# make sweep              table 1 of the paper, small: twelve variants over one dataset, and the table
# make sweep TABLE=priors the same of the priors that a renderer may be given
# make sweep SYSTEM=neuras  all tables of that system's paper, on one page
# make test               the tests
# Everything installs itself into .venv. All targets are phony: the store decides what is stale.

PYTHON ?= python3
# cpu or cuda: the CUDA build where an NVIDIA driver answers
TORCH ?= $(shell nvidia-smi >/dev/null 2>&1 && echo cuda || echo cpu)
TORCH_VERSION := 2.13.0
TORCH_CPU_INDEX ?= https://download.pytorch.org/whl/cpu
ARGS ?=
SYSTEM ?= renderformer
TABLE ?=

VENV := .venv
RUN := $(VENV)/bin/python
READY := $(VENV)/ready-$(TORCH)

PROBES := $(basename $(notdir $(wildcard conf/renderformer/probe/*.yaml)))
EMPTY :=
COMMA := ,

.PHONY: help setup data train eval sweep probes test lint
.NOTPARALLEL:
.DEFAULT_GOAL := help

help:
	@test ! -f conf/$(SYSTEM)/help.txt || cat conf/$(SYSTEM)/help.txt
	@echo
	@echo "make test      the tests          (TESTS=tests/model for some of them)"
	@echo "make lint      ruff"
	@echo "make setup     only create $(VENV) and install what is missing"
	@echo
	@echo "SYSTEM=NAME chooses the system (here: $(SYSTEM)), ARGS='...' passes Hydra overrides on"
	@echo "TORCH=cpu|cuda chooses the torch build (here: $(TORCH)); PYTHON=python3.12 the interpreter"

setup: $(READY)

# torch first: on Linux the plain package brings gigabytes of CUDA, so the CPU index is asked before it
$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "error: $(PYTHON) is older than 3.11: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 2; }
	@echo "installing into $(VENV) (torch: $(TORCH)); a few minutes the first time"
	@test -x $(RUN) || $(PYTHON) -m venv $(VENV)
ifeq ($(TORCH),cpu)
	@$(RUN) -m pip install -q --no-deps --retries 1 --index-url $(TORCH_CPU_INDEX) torch==$(TORCH_VERSION) 2>/dev/null || \
		$(RUN) -m pip install -q --no-deps torch==$(TORCH_VERSION)
else
	@$(RUN) -m pip install -q torch==$(TORCH_VERSION)
endif
	@$(RUN) -m pip install -q -r requirements.lock
	@$(RUN) -m pip install -q --no-deps --no-build-isolation -e .
	@$(RUN) -c 'import pymeshlab' || \
		{ echo "error: pymeshlab needs system libraries: apt-get install libgl1 libopengl0"; exit 2; }
	@rm -f $(VENV)/ready-* && touch $@

# The default of renderformer is two models on one dataset; model=, experiment= or train= in ARGS chooses one
DEFAULT := $(if $(filter-out renderformer,$(SYSTEM))$(filter model=% experiment=% train=%,$(ARGS)),,default)

ifeq ($(DEFAULT),)
data train eval: setup
	@$(RUN) -m pipeline system=$(SYSTEM) stage=$@ $(ARGS)
else
data: setup
	@$(RUN) -m pipeline stage=data shard=guided $(ARGS)

train: setup
	@$(RUN) -m stages.cli sweep $(DEFAULT) --until train $(ARGS)

eval: setup
	@$(RUN) -m stages.cli sweep $(DEFAULT) $(ARGS)
endif

probes: setup
	@$(RUN) -m pipeline stage=probe $(if $(DEFAULT),shard=guided) probe=$(subst $(EMPTY) $(EMPTY),$(COMMA),$(PROBES)) -m $(ARGS)

sweep: setup
	@$(RUN) -m stages.cli sweep $(TABLE) $(if $(filter-out renderformer,$(SYSTEM)),system=$(SYSTEM)) $(ARGS)

test: setup
	@$(RUN) -m pytest -n auto --dist loadfile --durations=10 $(TESTS)

lint: setup
	@$(RUN) -m ruff check .
	@$(RUN) -m ruff format --check .
