# No target needs preparation: each installs what it uses, once, into .venv.

# Candidates in order of preference; the first that runs and is new enough is taken.
PYTHON ?= python3 python3.14 python3.13 python3.12 python3.11 python
# Passed on to the command of a target: make train ARGS="seed=1 flow=squash"
ARGS ?=

VENV := .venv
PY := $(VENV)/bin/python
STAMP := $(VENV)/.installed
CONSTRAINTS := .ci/constraints.txt
# Of numbers on other processors. What torch.compile traces and what is refused does not depend on
# them, and other processors' rounding is simulated on one.
NUMERIC := $(filter-out %/test_compile.py %/test_other_processors.py %/test_refusals.py \
	%/test_validation.py,$(wildcard tests/bijectors/test_*.py tests/geometry/test_*.py)) \
	tests/test_distributions.py tests/modules/test_latent.py

.DEFAULT_GOAL := help
.PHONY: help install train evaluate audit view explain test test-slow test-rounding bench bench-anchors bench-layers bench-lines bench-updates paper figures docs check lint rooms types format clean

help: ## Show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-13s  %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

install: $(STAMP) ## Create .venv and install the project in it

train: $(STAMP) ## Train the default policy (ARGS="key=value ..." for Hydra overrides)
	$(PY) experiments/train.py $(ARGS)

evaluate: $(STAMP) ## Evaluate a trained run (ARGS="key=value ...")
	$(PY) experiments/evaluate.py $(ARGS)

test: $(STAMP) ## Run the fast tests
	$(PY) -m pytest -n auto $(ARGS)

test-slow: $(STAMP) ## Run the tests marked slow
	$(PY) -m pytest -m slow $(ARGS)

# PyTorch chooses its kernels when it is imported, and those of each vector unit round in their own
# way. `make test` takes the widest; this repeats what is about numbers with the narrower ones, which
# every such processor has too.
test-rounding: $(STAMP) ## Repeat the numeric tests with PyTorch's kernels for older processors
	@narrower=$$($(PY) -c 'import torch; \
		print(*{"AVX512": ["avx2", "default"], "AVX2": ["default"]}.get( \
			torch.backends.cpu.get_cpu_capability(), []))'); \
	for capability in $$narrower; do \
		echo "ATEN_CPU_CAPABILITY=$$capability"; \
		ATEN_CPU_CAPABILITY=$$capability $(PY) -m pytest -n auto $(NUMERIC) $(ARGS) || exit 1; \
	done

bench: $(STAMP) ## Time the flows against TanhNormal and projections (some 15 minutes)
	$(PY) experiments/benchmarks/flows.py $(ARGS)

bench-anchors: $(STAMP) ## Time anchors beside the flow and qpax's projection (some 3 minutes)
	$(PY) experiments/benchmarks/anchor_times.py $(ARGS)

bench-layers: $(STAMP) ## Time layers beside solvers, and count what each leaves broken (some 2 minutes)
	$(PY) experiments/benchmarks/layers.py $(ARGS)

bench-lines: $(STAMP) ## Time steps, paths and flows, a line each (ARGS="--line NAME")
	$(PY) experiments/benchmarks/lines.py $(ARGS)

bench-updates: $(STAMP) ## Time updates and training beside Stable-Baselines3 (some 10 minutes)
	$(PY) experiments/benchmarks/updates.py $(ARGS)

# A run that failed is told at the end, but takes no figure from the others.
paper: $(STAMP) ## Repeat the paper's experiment in outputs/paper, resumable (ARGS="key=value ...")
	$(PY) -m experiments.paper.run $(ARGS); status=$$?; \
	$(PY) -m experiments.paper.report outputs/paper && exit $$status

figures: $(STAMP) ## Redraw the figures and pages of the kept records in experiments/paper
	$(PY) -m experiments.paper.report $(ARGS)

# A reference that leads nowhere, a formula that cannot be set, a page in no table of contents and
# anything loaded from another host are errors.
docs: $(STAMP) ## Build the documentation's site in docs/_build/html
	$(PY) -m sphinx --quiet --jobs auto --fail-on-warning --keep-going -c docs . docs/_build/html $(ARGS)
	@echo docs/_build/html/index.html

audit: $(STAMP) ## Look for flaws in the constraints' geometry (ARGS="key=value ...")
	$(PY) experiments/audit.py $(ARGS)

view: $(STAMP) ## Open the newest recording in a Rerun viewer (ARGS="--web" for a browser)
	$(PY) -m cnfp_torchrl.commands.view $(ARGS)

explain: $(STAMP) ## Explain what a policy did in a step (ARGS="RUN --step N")
	$(PY) experiments/explain.py $(ARGS)

check: lint rooms types ## Check format, lint, imports between rooms, and types

lint: $(STAMP)
	$(PY) -m ruff format --check
	$(PY) -m ruff check

rooms: $(STAMP)
	$(VENV)/bin/lint-imports

types: $(STAMP)
	$(PY) -m mypy

format: $(STAMP) ## Format the code and mend what the linter can
	$(PY) -m ruff format
	$(PY) -m ruff check --fix

clean: ## Remove caches and build products (never .venv or outputs)
	rm -rf build dist .import_linter_cache .mypy_cache .pytest_cache .ruff_cache
	find cnfp_torchrl experiments tests -name __pycache__ -type d -prune -exec rm -rf {} +

# The constraints go through the environment because that also pins the isolated builds that pip
# starts; pip 25.3 and later read the second name for those.
$(STAMP): pyproject.toml $(CONSTRAINTS)
	@$(PY) -m pip --version >/dev/null 2>&1 && exit 0; \
	for candidate in $(PYTHON); do \
		if "$$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then \
			echo "creating $(VENV) with $$("$$candidate" --version)"; \
			exec "$$candidate" -m venv --clear $(VENV); \
		fi; \
	done; \
	echo "error: no Python 3.11 or newer among: $(PYTHON); name one with PYTHON=/path/to/python" >&2; \
	exit 1
	PIP_CONSTRAINT=$(CONSTRAINTS) PIP_BUILD_CONSTRAINT=$(CONSTRAINTS) PIP_DISABLE_PIP_VERSION_CHECK=1 \
		$(PY) -m pip install --quiet --editable '.[dev]'
	@touch $@
