# Needs python3 (3.10 to 3.13) and make; everything else goes into .venv. `make help` lists the targets.
# Settings: PYTHON=/path/to/python3 (for the set-up), ARGS='...' (handed to demo, test and bench).

VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

PYTHON ?=
ARGS ?=

# Tests are dealt out to a process a processor; more than four would want more memory than they save time.
TEST_PROCESSES := -n auto --maxprocesses 4 --dist worksteal

# Compiled numeric kernels are kept, so that only the first run pays for them.
export NUMBA_CACHE_DIR := $(CURDIR)/$(VENV)/numba-cache
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.DEFAULT_GOAL := help
.PHONY: help venv demo torture test check lint format-check types imports schemas-check bench fix lock build docs wheels images clean distclean

help: ## this list
	@echo "usage: make TARGET [PYTHON=/path/to/python3] [ARGS='...']"
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  %-14s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

# The stamp holds the folder that .venv was made in: a copied or moved tree sets up anew.
ifneq ($(shell cat $(READY) 2>/dev/null),$(CURDIR))
.PHONY: $(READY)
endif

# 3.11 first: that is where the pins in constraints.txt were tested most.
$(READY): pyproject.toml constraints.txt locks/dev.txt
	@python='$(PYTHON)'; \
	fits='import ensurepip, sys, venv; sys.exit(not (3, 10) <= sys.version_info < (3, 14))'; \
	if [ -z "$$python" ]; then \
	  for candidate in python3.11 python3.12 python3.10 python3 python3.13; do \
	    if "$$candidate" -c "$$fits" >/dev/null 2>&1; then python=$$candidate; break; fi; \
	  done; \
	fi; \
	if [ -z "$$python" ] || ! "$$python" -c "$$fits" >/dev/null 2>&1; then \
	  echo "set-up: need Python 3.10 to 3.13 with venv: install it (Debian, Ubuntu: apt install python3-venv) or name one: make venv PYTHON=/path/to/python3" >&2; \
	  exit 1; \
	fi; \
	echo "set-up: $$("$$python" --version) into $(VENV), some minutes and 2 to 3 GB the first time"; \
	if [ ! -x $(BIN)/python ] || [ "$$(cat $(READY) 2>/dev/null)" != '$(CURDIR)' ]; then \
	  "$$python" -m venv --clear $(VENV) || exit 1; \
	fi; \
	rm -f $(READY); \
	$(BIN)/python -m pip install -qq --no-deps --require-hashes -r locks/dev.txt || exit 1; \
	$(BIN)/python -m pip install -qq -c constraints.txt torch || exit 1; \
	$(BIN)/python -m pip install -qq --no-deps --no-build-isolation -e . || exit 1; \
	$(BIN)/python -c 'import open3d' 2>/dev/null || \
	  echo "set-up: open3d misses system libraries; Debian, Ubuntu: apt install libgl1 libgomp1 libusb-1.0-0 libx11-6" >&2; \
	printf '%s\n' '$(CURDIR)' > $(READY)

# Hashes of everything that the images and the set-up install; torch has none, because its builds (CPU, CUDA) come from different
# places with hashes of their own, and what only CUDA builds need is left out.
TORCH_ONLY := torch triton cuda-bindings cuda-pathfinder cuda-toolkit nvidia-cublas nvidia-cuda-cupti nvidia-cuda-nvrtc \
	nvidia-cuda-runtime nvidia-cudnn-cu13 nvidia-cufft nvidia-cufile nvidia-curand nvidia-cusolver nvidia-cusparse \
	nvidia-cusparselt-cu13 nvidia-nccl-cu13 nvidia-nvjitlink nvidia-nvshmem-cu13 nvidia-nvtx
LOCK = $(BIN)/uv pip compile -q --universal --python-version 3.10 --generate-hashes --no-header --no-annotate \
	-c constraints.txt $(TORCH_ONLY:%=--no-emit-package %)

venv: $(READY) ## set up .venv: both commands and all tools
	@echo "set-up: ready; the commands are $(BIN)/potserver and $(BIN)/potclient"

demo: $(READY) ## a server, robots and queries on this machine; pictures into out/demo
	@echo "demo: potserver demo $(ARGS)"
	@$(BIN)/potserver demo $(ARGS)

test: $(READY) ## all tests
	@echo "test: pytest $(TEST_PROCESSES) $(ARGS)"
	@$(BIN)/python -m pytest $(TEST_PROCESSES) --junit-xml=out/test/junit.xml $(ARGS)
	@echo "test: results above, and in out/test/junit.xml"

check: lint format-check types imports schemas-check ## style, types, layers, generated schemas

lint: $(READY)
	$(BIN)/ruff check .

format-check: $(READY)
	$(BIN)/ruff format --check .

types: $(READY)
	$(BIN)/python -m mypy

imports: $(READY)
	$(BIN)/lint-imports --no-logo

schemas-check: $(READY)
	$(BIN)/python -m potschemas.generate --check

fix: $(READY) ## repair style and format; write the generated schemas
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/python -m potschemas.generate
	$(BIN)/potserver config show --markdown > docs/settings.md

bench: $(READY) ## benchmarks; tables here, numbers into out/bench
	@mkdir -p out/bench
	@$(BIN)/python -m pytest benchmarks --benchmark-only --benchmark-json=out/bench/bench.json $(ARGS)
	@$(BIN)/python benchmarks/ratios.py bundled:rooms --peers octomap:0.2,bgk-gap:0.2 --json out/bench/ratios.json
	@echo "bench: results above, and in out/bench"

torture: $(READY) ## faults, damage, hostile messages and kills; some minutes. ARGS='--help' tells of longer runs
	@$(BIN)/python benchmarks/torture.py $(ARGS)

lock: $(READY) ## write locks/ anew, after a change of pyproject.toml or constraints.txt
	@$(LOCK) pyproject.toml --extra ros -o locks/server.txt
	@$(LOCK) clients/pyproject.toml -o locks/client.txt
	@$(LOCK) pyproject.toml --extra dev -o locks/dev.txt
	@printf 'cyclonedx-bom\nhatchling\n' | $(LOCK) - -o locks/build.txt

build: $(READY) ## wheels of potserver and of the torch-free potclient, into dist
	$(BIN)/python -m hatchling build -d dist
	cd clients && ../$(BIN)/python -m hatchling build -t wheel -d ../dist

docs: $(READY) ## the site of the documents, into out/docs (Python 3.11 or newer)
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "docs: open out/docs/index.html, or serve them: $(BIN)/python -m http.server -d out/docs"

wheels: build ## the wheels in bare environments, from a folder of wheels alone: out/wheels
	@bash .ci/wheels

images: ## the server's and the client's container images
	docker compose -f docker/compose.yaml --profile load build

clean: ## delete results, builds and caches; keep .venv
	rm -rf out dist build .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache .benchmarks
	find benchmarks clients potserver schemas tests -name __pycache__ -prune -exec rm -rf {} +

distclean: clean ## delete .venv too
	rm -rf $(VENV)
