# `make demo` and `make test` do all their own set-up in .venv; nothing but Python 3.10+ and make is needed. `make help` lists the verbs.
PYTHON ?= python3
PIP := .venv/bin/python -m pip --disable-pip-version-check
BIN := .venv/bin
# pip does this for what it copies, but not for what it links to; where Python may not do it either, a start takes 0.2 CPU s more.
COMPILE := @$(BIN)/python -m compileall -q src
COMPILED := $(wildcard src/pcdenoise/*/*.[ch])

.DEFAULT_GOAL := help
.PHONY: help setup demo test lint types docs site bench clean

help: ## list the verbs
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-7s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: .venv/dev.stamp ## make .venv with pcdenoise and everything a developer needs

demo: .venv/run.stamp ## clean the shipped scan with the shipped model and show before and after, in demo/
	@mkdir -p demo
	$(BIN)/pcdenoise denoise examples/ground.laz -o demo/ground_clean.laz --overwrite \
		--picture demo/before_after.png --report demo/report.html
	@echo "Look at demo/before_after.png, open demo/report.html in a browser; the clean scan is demo/ground_clean.laz."

test: .venv/dev.stamp ## all tests, two at a time
	$(BIN)/python -m pytest -n 2 --dist worksteal

lint: .venv/dev.stamp ## ruff (style and bugs) and import-linter (the layers)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

types: .venv/dev.stamp ## mypy --strict
	$(BIN)/mypy

docs: .venv/dev.stamp ## rebuild the command reference and the README's picture, and run every command of README and docs/
	$(BIN)/python docs/reference.py
	$(BIN)/python docs/pictures.py
	$(BIN)/python -m pytest tests/test_docs.py

site: .venv/dev.stamp ## docs/ as web pages, in build/site
	$(BIN)/mkdocs build --strict

bench: .venv/run.stamp ## the shipped model and a classical filter on shapes whose surface is known
	$(BIN)/pcdenoise synth shapes:3 -o demo/bench --points 10000 --levels 1 --seed 1 --overwrite
	$(BIN)/pcdenoise denoise 'demo/bench/*_gaussian_1.ply' -o demo/bench/network/ --overwrite --quiet
	$(BIN)/pcdenoise denoise 'demo/bench/*_gaussian_1.ply' -o demo/bench/jet/ --method jet --overwrite --quiet
	@for shape in shape_0000 shape_0001 shape_0002; do cd demo/bench && ../../$(BIN)/pcdenoise eval-chamfer \
		$${shape}_gaussian_1.ply jet/$${shape}_gaussian_1.ply network/$${shape}_gaussian_1.ply --clean $${shape}_clean.ply && cd ../..; done

clean: ## remove .venv and what demo and bench wrote
	rm -rf .venv demo build

# A stamp is as new as the last set-up; pip runs again when the dependencies or what it compiles change.
.venv/bin/python:
	@echo "Setting up .venv; the first time takes a minute or two."
	$(PYTHON) -m venv .venv

.venv/run.stamp: .venv/bin/python pyproject.toml constraints.txt $(COMPILED)
	$(PIP) install -q -c constraints.txt -e .
	$(COMPILE)
	@touch $@

.venv/dev.stamp: .venv/bin/python pyproject.toml constraints.txt $(COMPILED)
	$(PIP) install -q -c constraints.txt -e '.[dev]'
	$(COMPILE)
	@touch $@ .venv/run.stamp
