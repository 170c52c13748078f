# make setup      .venv with everything (idempotent)
# make test       set-up, style, tests (no GPU, no dataset, no network beyond the set-up)
# make test-gpu   what needs a GPU: the rasterizers agree, trainings resume
# make config     config.yaml and config.schema.json from the settings' definitions
.PHONY: setup test lint test-gpu config

BIN := .venv/bin
WORKERS ?= 2

setup:
	@bash scripts/setup.sh

test: setup lint
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal -m "not gpu"

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/snakefmt --check Snakefile rules
	$(BIN)/snakemake --lint

# Uses the Python at hand where there is no .venv: GPU machines often bring their own torch.
test-gpu:
	$(if $(wildcard $(BIN)/python),$(BIN)/python,python3) -m pytest -m gpu -rs -v

config: setup
	$(BIN)/python -m drivesplat.config_document
