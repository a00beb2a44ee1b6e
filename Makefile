# Two commands on a fresh clone: `make demo` and `make test`. They need python3 (3.11 to 3.13) and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SETUP := $(VENV)/.installed

.PHONY: demo test lint assets bench clean

demo: $(SETUP)  ## Table I for two methods over all 16 objects, on a small number of trials
	$(BIN)/python -m r2h_batch.sweep --method random oracle --splits S0 S1 --trials 60 --out runs/demo

test: $(SETUP) $(VENV)/.installed-test  ## linters, types, tests
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -q

$(SETUP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if (3, 11) <= v <= (3, 13) else f"r2h_batch needs Python 3.11 to 3.13; $(PYTHON) is {v[0]}.{v[1]}. Try: make PYTHON=python3.12 demo")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -q -c constraints.txt -e .
	touch $@

$(VENV)/.installed-test: $(SETUP)
	$(BIN)/python -m pip install -q -c constraints.txt -e '.[test]'
	touch $@

assets: $(VENV)/.installed-test  ## rebuilds everything under assets/ from its scripts
	$(BIN)/python -m r2h_batch.assets.robot.build_robot
	$(BIN)/python -m r2h_batch.assets.robot.build_ik_seeds
	$(BIN)/python -m r2h_batch.assets.hand.build_hand
	$(BIN)/python -m r2h_batch.assets.hand.build_handset
	$(BIN)/python -m r2h_batch.assets.objects.build_objects
	$(BIN)/python -m r2h_batch.assets.objects.build_grasps
	$(BIN)/python -m r2h_batch.assets.receiving.build_receiving
	$(BIN)/python -m r2h_batch.predictors.train_voxnet

bench: $(VENV)/.installed-test  ## all benchmarks, results under bench/results/
	for b in collision ik plan throughput execute methods; do $(BIN)/python bench/$$b.py --json bench/results/$$b.json; done

clean:
	rm -rf $(VENV) build *.egg-info
