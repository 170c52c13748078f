# make demo         set-up, then the whole workflow on a synthetic drive: no dataset, no GPU, minutes
# make setup        .venv with all packages; compiles gsplat where there is an NVIDIA GPU (idempotent; docs/installation.md)
# make doctor       check the machine and suggest remedies
# make test         set-up, style, tests (no GPU, no dataset, no network beyond the set-up)
# make test-slow    whole runs and fits that make test leaves out (two cores: ten minutes)
# make test-viewers pages and exports in Chromium, and in other viewers (apt-get install chromium; docs/exports.md)
# make test-gpu     tests that need a GPU: the rasterizers agree, trainings resume
# make test-slurm   one scene through a real SLURM, started on this machine for the test (root on Debian; docs/cluster.md)
# make test-batch   ten synthetic drives, one of them broken, as a batch (two cores: a quarter of an hour)
# make mutants      30 deliberate faults, each of which the tests must find (two cores: an hour)
# make bench        the measurements of benchmarks/ against their bounds (two idle cores)
# make quality      RECIPES=file: train recipes with several seeds on one scene, and write their table (docs/quality.md)
# make speed        FILE=file: training time and quality beside gsplat's example trainer (docs/speed.md)
# make ledger       docs/tried.md from the ledger of experiments docs/tried.csv
# make config       config.yaml, config.schema.json, docs/settings.md from the settings records; FORCE=--force overwrites
# make help         this list
.PHONY: help demo setup doctor test test-slow test-viewers lint test-gpu test-slurm test-batch mutants bench quality speed config ledger

BIN := .venv/bin
WORKERS ?= 2
CORES ?= all

demo: setup
	$(BIN)/snakemake --cores $(CORES) --configfile presets/demo.yaml -- all
	@$(BIN)/drivesplat show results/demo

help:
	@sed -n 's/^# make/make/p' $(firstword $(MAKEFILE_LIST))

setup:
	@bash scripts/setup.sh

doctor:
	@bash scripts/doctor.sh $(CONFIG)

test: setup lint
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal -m "not gpu and not slurm and not batch and not slow and not viewers"

test-slow: setup
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal -m slow

test-viewers: setup
	$(BIN)/python -m pytest -m viewers -rs -v

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/snakefmt --check Snakefile rules
	$(BIN)/snakemake --lint
	$(BIN)/python -m scripts.check_texts

# Uses the Python at hand where there is no .venv: GPU machines often bring their own torch. Imports only modules with
# GPU tests, since such a machine may lack what the others need (ffmpeg, usd-core, ...).
GPU_PYTHON = $(if $(wildcard $(BIN)/python),$(BIN)/python,python3)
test-gpu:
	$(GPU_PYTHON) -m pytest -m gpu -rs -v $$(grep -rl --include='*.py' 'pytest\.mark\.gpu' tests)
	$(GPU_PYTHON) -m pytest -rs -v tests/kernels/test_triton*.py

test-slurm: setup
	bash scripts/with_slurm.sh $(BIN)/python -m pytest -m slurm -rs -v tests/workflow/test_slurm.py

test-batch: setup
	DRIVESPLAT_BATCH=1 $(BIN)/python -m pytest -m batch -rs -v tests/workflow/test_batch.py

mutants: setup
	$(BIN)/python -m benchmarks.mutants

bench: setup
	$(BIN)/python -m pytest benchmarks -q

# SNAKEMAKE="--resources gpu=8 --scheduler greedy": further arguments of Snakemake
quality: setup
	@test -n "$(RECIPES)" || { echo "make quality RECIPES=benchmarks/recipes/demo.yaml" >&2; exit 2; }
	$(BIN)/python -m benchmarks.quality $(RECIPES) -- --cores $(CORES) $(SNAKEMAKE)

speed: setup
	@test -n "$(FILE)" || { echo "make speed FILE=benchmarks/speed/demo.yaml" >&2; exit 2; }
	$(BIN)/python -m benchmarks.speed $(FILE) -- --cores $(CORES) $(SNAKEMAKE)

config: setup
	$(BIN)/python -m drivesplat.settings.config_document $(FORCE)

ledger: setup
	$(BIN)/python -m benchmarks.tried
