# Everything a person needs to type. `make` alone explains itself.
.DEFAULT_GOAL := help
SHELL := bash
.SHELLFLAGS := -euo pipefail -c

PYTHON ?= python3
VENV ?= .venv
# e.g. PIP_ARGS="--extra-index-url https://download.pytorch.org/whl/cpu" for the small CPU build of torch
PIP_ARGS ?=
ATLAS ?=
# e.g. PRETRAIN_ARGS="--trainer.max_time 00:00:10:00"; POSE_ARGS and MASK_ARGS likewise
PRETRAIN_ARGS ?=
POSE_ARGS ?=
MASK_ARGS ?=
BENCH_ARGS ?=
STUDY_ARGS ?=
# processes of `make test`; the tests of a file stay together, since they share what they reconstruct
TEST_JOBS ?= 2
# of `make bench`: folders of g3r-simulate; phantoms are made when empty
CASES ?=
PHANTOM_CASES := runs/bench/phantom-cases
# of `make study-prior.networks`: small patches of subjects that all variants share
SHORT_TRAINING ?= --data.num_workers=0 --data.patch_size=32 --data.batch_size=2 --data.distinct_epochs=2 \
	--model.warmup_steps=60 --trainer.check_val_every_n_epoch=2
# of `make study-prior.gate`: a small network, so that thirty trainings end; torch convolves batches of one patch
# three times more slowly
GATE_TRAINING ?= --data.num_workers=0 --data.patch_size=64 --data.batch_size=2 --data.distinct_epochs=2 \
	--data.subjects_per_epoch=24 --data.patches_per_subject=8 --model.network.channels=[16,32,48] \
	--model.learning_rate=1e-3 --model.warmup_steps=40 --trainer.check_val_every_n_epoch=100
PRIOR ?= runs/prior.safetensors
POSE ?= runs/pose.safetensors
MASK ?= runs/mask.safetensors
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# the best checkpoint of the newest run below a folder, or its last one ("best..." sorts before "last")
best_of = ls "$$(ls -dt $(1)/version_*/checkpoints | head -n 1)"/*.ckpt | head -n 1

.PHONY: help install demo docs docs-serve test coverage test-slow test-numerics test-faults container-check lint types pretrain tensorboard bench bench-phantom fit-uncertainty results clean

help: ## show this list
	@grep -hE '^[a-z%-]+:.*## ' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | awk -F'\t' '{printf "  make %-15s %s\n", $$1, $$2}'
	@echo "studies, for make study-NAME:"
	@grep -rhoE '^"""`python -m studies\.[a-z._]+`: .*' studies | sed -E 's/^[^`]*`python -m studies\.([a-z._]+)`: (.*[^."]).*$$/\1\t\2/' \
		| sort | awk -F'\t' '{printf "  %-24s %s\n", $$1, $$2}'

install: $(STAMP) ## make .venv with g3r and everything it needs

$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet $(PIP_ARGS) -c constraints.txt -e '.[dev]'
	touch $@

demo: install ## simulate a moving 30-week brain, reconstruct it, score it: a volume and a picture in demo/
	rm -rf demo
	$(BIN)/g3r-simulate --phantom 30 --motion moderate --stacks 3 --resolution 1.0 --thickness 3.0 --seed 1 --output demo/case
	$(BIN)/g3r-infer --stacks demo/case/stack-{0,1,2}.nii.gz --masks demo/case/mask-{0,1,2}.nii.gz --thickness 3.0 \
		--seed 1 --output demo/reconstruction
	$(BIN)/g3r-evaluate --align --volume demo/reconstruction/volume.nii.gz \
		--reference demo/case/truth.nii.gz --mask demo/case/truth-mask.nii.gz \
		--poses demo/case/poses.tsv --slices demo/reconstruction/slices.tsv \
		--json demo/scores.json --sections demo/comparison.png
	@echo
	@echo "volume:   demo/reconstruction/volume.nii.gz"
	@echo "picture:  demo/comparison.png (truth, reconstruction, error), demo/reconstruction/sections.png"

test: install ## lint, types and all quick tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/pytest -n $(TEST_JOBS) --dist loadfile

coverage: install ## the quick tests, and which lines they reach
	$(BIN)/pytest --cov --cov-report=term:skip-covered

test-slow: install ## the tests that take minutes
	$(BIN)/pytest -m slow

test-numerics: install ## numbers at the extremes: the tables of docs/numerics.md, checked
	$(BIN)/pytest -m "numerics or not slow" tests/numerics

test-faults: install ## bad input by the hundred, fuzzed headers, kills, full disks, limits
	$(BIN)/pytest -m "faults or not slow" tests/faults

container-check: install ## the install steps of Dockerfile and Apptainer recipe, run in a clean environment (minutes)
	$(BIN)/pytest -m "slow or not slow" tests/test_container.py

docs: install ## the documentation site, in build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

docs-serve: install ## the site while you write, on http://127.0.0.1:8000
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs serve

lint: install ## ruff: style, imports, docstrings
	$(BIN)/ruff check .

types: install ## mypy
	$(BIN)/mypy

pretrain: install ## train all networks on the phantom, or on ATLAS=DIR, and export them to POSE, PRIOR and MASK
	$(BIN)/g3r-pretrain fit --config lightning_configs/pose.yaml $(if $(ATLAS),--data.source "$(ATLAS)") $(POSE_ARGS)
	$(BIN)/g3r-export --force "$$($(call best_of,runs/pose))" $(POSE)
	$(BIN)/g3r-pretrain fit --config lightning_configs/prior.yaml $(if $(ATLAS),--data.source "$(ATLAS)") $(PRETRAIN_ARGS)
	$(BIN)/g3r-export --force "$$($(call best_of,runs/prior))" $(PRIOR)
	$(BIN)/g3r-pretrain fit --config lightning_configs/mask.yaml $(if $(ATLAS),--data.source "$(ATLAS)") $(MASK_ARGS)
	$(BIN)/g3r-export --force "$$($(call best_of,runs/mask))" $(MASK)

tensorboard: install ## watch the training runs
	$(BIN)/tensorboard --logdir runs

study-%: install ## measure what a table of docs/ shows, and write it there (most need G3R_TEST_DATA; STUDY_ARGS=--fresh)
	$(BIN)/python -m studies.$* --publish $(STUDY_ARGS) $(STUDY_MORE)

study-prior.ablation: STUDY_MORE = --jobs 2
study-prior.networks: STUDY_MORE = -- $(SHORT_TRAINING)
study-prior.gate: STUDY_MORE = -- $(GATE_TRAINING)

study-uncertainty.calibration: install
	$(BIN)/python -m studies.uncertainty.calibration check --no-prior $(STUDY_ARGS)
	$(BIN)/python -m studies.uncertainty.calibration check --publish $(STUDY_ARGS)

fit-uncertainty: install ## coefficients of uncertainty.nii.gz, with and without prior (G3R_TEST_DATA), about 10 min
	$(BIN)/python -m studies.uncertainty.calibration fit $(STUDY_ARGS)
	$(BIN)/python -m studies.uncertainty.calibration fit --no-prior $(STUDY_ARGS)

bench: install ## kernels, scaling and speed against accuracy, on phantoms or on CASES="DIR ..." (BENCH_ARGS=--sweeps)
	$(if $(CASES),,$(BIN)/g3r-simulate --phantom 30 --resolution 0.8 --thickness 3 --seed 61002 --force --output $(PHANTOM_CASES)/phantom-30)
	$(if $(CASES),,$(BIN)/g3r-simulate --phantom 24 --resolution 0.8 --thickness 3 --seed 61003 --force --output $(PHANTOM_CASES)/phantom-24)
	$(BIN)/g3r-bench kernels
	$(BIN)/g3r-bench scaling --docs docs/tradeoff.md --figure docs/images/scaling.png
	$(BIN)/g3r-bench trade $(or $(CASES),$(PHANTOM_CASES)/phantom-30 $(PHANTOM_CASES)/phantom-24) \
		--docs docs/tradeoff.md --figure docs/images/tradeoff.png $(BENCH_ARGS)

bench-phantom: install ## a small phantom of the size that other methods were timed on: seconds of `fast`
	$(BIN)/python -m studies.tradeoff.peer_phantom --force --output $(PHANTOM_CASES)/small
	$(BIN)/g3r-bench trade $(PHANTOM_CASES)/small --presets fast --output runs/bench/phantom $(BENCH_ARGS)

results: install ## docs/results.md anew, from the tables that studies have published in the other pages
	$(BIN)/python -m studies.results.page

clean: ## remove demo, builds and caches; runs/ (trainings, exported weights, measurements) and .venv stay
	rm -rf demo build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find g3r data_synth studies tests -name __pycache__ -type d -prune -exec rm -rf {} +
