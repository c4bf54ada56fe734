SHELL := /bin/bash
.DEFAULT_GOAL := help
.PHONY: help setup transforms demo results check test battery lint clean

BIN := .venv/bin
DEMO := bags/demo
PYTHON_FILES := src tests examples

help:  ## this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "make %-8s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup:  ## make .venv ready (done by the others, too)
	@scripts/setup.sh

transforms: setup  ## messages of /tf for a .venv from PyPI: compiles tf2_msgs once
	@scripts/make_transforms.sh

demo: setup  ## one episode on a heap of cups: a bag and a report in bags/demo
	rm -rf $(DEMO)
	$(BIN)/active6d episode --object coffee_cup --seed 7 --steps 5 --bag $(DEMO) --report $(DEMO)/report.html
	@echo "Open $(DEMO)/report.html in a browser; the bag beside it opens in Foxglove, ros2 bag and rosbags."

results: setup  ## what docs/results.md shows and is not measured yet, except trainings
	$(BIN)/python -m active6d_tools.results.reproduce

test: setup  ## all tests, in three processes: they wait for nodes most of the time
	$(BIN)/python -m pytest tests -n 3 --dist loadfile

battery: setup  ## attacks on messages, files, graphs, processes and commands for 20 minutes
	$(BIN)/python tests/battery --seconds 1200

check: lint  ## what needs no run: lint, format, types, layers, links of the documentation
	$(BIN)/mypy
	$(BIN)/python -m pytest -q --durations=0 --durations-min=60 tests/core/test_layers.py $(wildcard tests/packaging/test_docs.py)

lint: setup  ## ruff: lint and format of all Python files
	$(BIN)/ruff check $(PYTHON_FILES)
	$(BIN)/ruff format --check $(PYTHON_FILES)

clean:  ## remove .venv, builds and the demo
	rm -rf .venv ros2_ws/{build,install,log} $(DEMO) src/*/*.egg-info src/*/build .pytest_cache .mypy_cache .ruff_cache .hypothesis
