SHELL := /bin/bash
.DEFAULT_GOAL := help
.PHONY: help setup demo results test lint clean

BIN := .venv/bin
DEMO := bags/demo

help:  ## this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "make %-8s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup:  ## make .venv ready (done by the others, too)
	@scripts/setup.sh

demo: setup  ## one episode on a heap of cups: a bag and a report in bags/demo
	rm -rf $(DEMO)
	$(BIN)/active6d episode --object coffee_cup --seed 7 --steps 5 --bag $(DEMO) --report $(DEMO)/report.html
	@echo "Open $(DEMO)/report.html in a browser; the bag beside it opens in Foxglove, ros2 bag and rosbags."

results: setup  ## what docs/results.md shows and is not measured yet, except trainings
	$(BIN)/python -m active6d_tools.results.reproduce

test: setup  ## all tests
	$(BIN)/python -m pytest tests

lint: setup  ## ruff on all Python files
	$(BIN)/ruff check src tests

clean:  ## remove .venv, builds and the demo
	rm -rf .venv ros2_ws/{build,install,log} $(DEMO) src/*/*.egg-info src/*/build .pytest_cache .ruff_cache .hypothesis
