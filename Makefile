# `make` alone lists the targets.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

# Of each half of `make fuzz`.
SECONDS ?= 120

.PHONY: help demo test build lint rust-test rust-test-debug python-test fuzz bench peers train-gpu format clean

help: ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## / — /'

demo: $(VENV)/demo ## build, install, reconstruct the bundled sample
	$(BIN)/mvcore demo -o out
	@echo "the mesh lies at $(CURDIR)/out/pickup.glb"

$(VENV)/demo:
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet .
	@touch $@

test: lint rust-test rust-test-debug python-test ## formatting, lints, Rust and Python tests

build: ## install into the environment with what the tests need
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet '.[test]'

lint: build ## formatting and lints
	cargo fmt --all --check
	cargo clippy --workspace --all-targets --quiet -- -D warnings
	$(BIN)/ruff format --check python tests benches examples
	$(BIN)/ruff check python tests benches examples
	cd tests && ../$(BIN)/python -m mypy.stubtest mvcore._core --mypy-config-file ../pyproject.toml

rust-test: ## tests of the kernels
	cargo test --release --quiet --package mvcore

rust-test-debug: ## the same with overflow checks and debug assertions
	cargo test --quiet --package mvcore --lib

fuzz: build ## mutated files for every reader, mad arguments for every kernel, SECONDS each (120); what fails is kept in out/fuzz
	cd tests && ../$(BIN)/python -m fuzz.readers --seconds $(SECONDS) --seed $$(date +%s) --keep ../out/fuzz
	cd tests && ../$(BIN)/python -m fuzz.kernels --seconds $(SECONDS) --seed $$(date +%s)

python-test: build ## tests of the package
	$(BIN)/python -m pytest -q tests

bench: ## throughput of each kernel
	cargo bench --package mvcore

peers: build ## each kernel beside what a user would pick instead
	$(BIN)/pip install --quiet '.[peers]'
	$(BIN)/python benches/peers.py
	$(BIN)/python benches/nurbs_peers.py

MINUTES ?= 12
OUT ?= out/train-gpu
train-gpu: ## train the disparity network further on one GPU, for MINUTES, into OUT: weights, log, figures
	$(BIN)/python -m mvcore.cli.main train disparity --device cuda --start python/mvcore/network/disparity.safetensors \
		--batch 16 --size 320x256 --rate 1e-3 --steps 100000 --every 600 --seed 3 --replay 4096 \
		--workers $$(($$(nproc) - 1)) --hours $$(awk 'BEGIN { print $(MINUTES) / 60 }') --out $(OUT)

format: build ## rewrite the sources in the project's format
	cargo fmt --all
	$(BIN)/ruff format python tests benches examples

clean: ## remove what was built
	rm -rf $(VENV) target out
