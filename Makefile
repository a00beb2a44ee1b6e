# Two commands on a fresh clone: `make demo` and `make test`. They need python3 (3.11 to 3.13) and make. `make help`: the rest.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SETUP := $(VENV)/.installed

.PHONY: help demo test test-all test-touched alone beside lint check quick-tests stale golden tables docs assets bench watch wheel lock licences audit gpu clean

help:  ## this list
	@sed -n 's/^\([a-z-]*\):[^#]*##  *\(.*\)/make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 16

demo: $(SETUP)  ## Table I for two methods over all 96 objects, on a small number of trials
	$(BIN)/python -m r2h_batch.sweep --method random oracle --splits S0 S1 --trials 60 --out runs/demo

# Two processes, each with one thread of torch and BLAS: more threads than cores only wait for each other.
# And two goes, because a process that runs all tests grows to 9 GB. Where a process is killed the run ends: xdist would wait for ever.
# Files come in this order, short ones last: xdist would begin with those of many tests, and one process would end long after the other.
BESIDE := tests/kernels
FIRST_ROOMS := $(addprefix tests/,judge methods training observe trials)
# Of these files the first and the third, of one process, need the kernels of MuJoCo-Warp, which take a minute to compile; those of the other do not.
BEGIN := $(addprefix tests/judge/,motion/test_motion.py calls/test_gradients.py motion/test_motion_faults.py calls/test_torch_use.py)
OF_JUDGE := $(sort $(wildcard tests/judge/test_*.py tests/judge/*/test_*.py))
FIRST_GO := $(BEGIN) $(filter-out $(BEGIN),$(OF_JUDGE)) $(filter-out tests/judge,$(FIRST_ROOMS))
ROOMS := $(sort $(shell find tests -mindepth 2 -name 'test_*.py' | cut -d/ -f1,2))
SECOND_GO := $(filter-out $(BESIDE) $(FIRST_ROOMS),$(ROOMS)) $(sort $(wildcard tests/test_*.py))
ALONE := $(shell grep -rl --include='test_*.py' 'mark\.alone' tests)
QUICK := $(shell grep -rl --include='test_*.py' 'mark\.check' tests)
EVERY_DAY := -m "not slow and not gpu and not whole and not alone"
PYTEST := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -q
TOGETHER := $(PYTEST) --durations=25 -n 2 --dist loadfile --no-loadscope-reorder --max-worker-restart 0
unexport PYTHONDONTWRITEBYTECODE  # else each of these processes compiles package and tests anew

test: $(VENV)/.installed-test  ## linters, types, and the tests of every day; tells what was left out and how to get it
	@$(MAKE) --no-print-directory -j2 --output-sync=target beside alone  # each keeps one core busy, and neither the other
	$(TOGETHER) $(EVERY_DAY) $(FIRST_GO)
	$(TOGETHER) $(EVERY_DAY) $(SECOND_GO)

alone: $(VENV)/.installed-test
	$(BIN)/python -m pytest -q -m "alone and not slow and not gpu and not whole" $(ALONE)

beside: lint  # linters, and tests for as long as `alone` takes
	$(PYTEST) $(EVERY_DAY) $(BESIDE)

test-all: lint  ## every test that needs no GPU: before a release
	$(TOGETHER) -o faulthandler_timeout=0 -m "not gpu and not alone" $(BESIDE) $(FIRST_GO)
	$(TOGETHER) -o faulthandler_timeout=0 -m "not gpu and not alone" $(SECOND_GO)
	$(BIN)/python -m pytest -q -o faulthandler_timeout=0 -m "alone and not gpu" $(ALONE)

test-touched: $(VENV)/.installed-test  ## of test-all beyond test, the parts whose sources a change touches (tests/touched.tsv)
	parts=$$($(BIN)/python tools/touched.py) && if [ -n "$$parts" ]; then $(TOGETHER) -m "$$parts"; fi

lint: $(VENV)/.installed-test  ## rules, formatting, types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python tests/support/types_of_all.py

check:  ## before every commit: lint, contracts, the quick half of golden and a quick test of each folder; lists stale figures; two jobs at once
	@$(MAKE) --no-print-directory -j2 --output-sync=target lint quick-tests
	@$(MAKE) --no-print-directory stale

quick-tests: $(VENV)/.installed-test
	$(PYTEST) -n 2 --dist loadfile --max-worker-restart 0 -m "check and not slow and not whole" $(QUICK)

golden: $(VENV)/.installed-test  ## rewrites tests/golden.json; CONTRIBUTING.md says when that is allowed
	$(BIN)/python tests/support/golden.py --write

tables: $(VENV)/.installed-test  ## all published rows, tables, findings and pictures, from a clean commit, after anything that moves a verdict
	$(BIN)/python bench/tables.py

$(SETUP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if (3, 11) <= v <= (3, 13) else f"r2h_batch needs Python 3.11 to 3.13; $(PYTHON) is {v[0]}.{v[1]}. Try: make PYTHON=python3.12 demo")'
	@echo 'installing into $(VENV): some minutes'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -q -c constraints.txt -e .
	touch $@

$(VENV)/.installed-test: $(SETUP)
	$(BIN)/python -m pip install -q -c constraints.txt -e '.[test]'
	touch $@

docs: $(SETUP)  ## the documentation as a site, build/site/index.html: strict, without network, notebooks run
	$(BIN)/python -c 'import mkdocs, mkdocstrings, IPython, nbformat, viser' 2>/dev/null || $(BIN)/python -m pip install -q -c constraints.txt -e '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict  # with -q no warning is counted

assets: $(VENV)/.installed-test  ## rebuilds everything under assets/ from its scripts
	$(BIN)/python -m r2h_batch.assets.robot.build_robot
	$(BIN)/python -m r2h_batch.assets.hand.build_hand
	$(BIN)/python -m r2h_batch.assets.hand.build_handset
	$(BIN)/python -m r2h_batch.assets.objects.build_objects
	$(BIN)/python -m r2h_batch.assets.objects.build_grasps
	$(BIN)/python -m r2h_batch.assets.people.build_people
	$(BIN)/python -m r2h_batch.assets.people.build_receiving
	$(BIN)/python -m r2h_batch.assets.families.build_families
	$(BIN)/python -m r2h_batch.assets.objects.build_inner_balls
	$(BIN)/python -m r2h_batch.assets.families.build_families --training build/families
	$(BIN)/python -m r2h_batch.assets.families.train_contacts --training build/families --left-out-steps 500 --left-out hammer,bottle,toothbrush,cup screwdriver,scissors,binoculars,bowl pliers,knife,headphones,wineglass power_drill,trigger_sprayer,eyeglasses,game_controller
	$(BIN)/python -m r2h_batch.assets.families.train_unseen
	$(BIN)/python -m r2h_batch.assets.receiving.build_receiving
	$(BIN)/python -m r2h_batch.assets.receiving.build_held_out
	$(BIN)/python -m r2h_batch.assets.receiving.train_voxnet

BENCHES := rating adversary generators throughput training_loop gradients collision ik plan execute growth meshes gates networks observe_export
BENCH_RUNS := runs/bench-$(shell git rev-parse --short HEAD 2>/dev/null)
bench: $(VENV)/.installed-test  ## every figure of the pages, measured in one go, and the pages written anew (RELEASE=checkout of the authors' release, VENDORS=folder of robots, SCANNED=folder, SCANS=folder of meshes, ARMS=folder for packages)
	set -e; for b in $(BENCHES); do $(BIN)/python bench/$$b.py --json bench/results/$$b.json; done
	$(BIN)/python bench/soak.py --json bench/results/long.json
	$(BIN)/python bench/closed_loop.py --growth 2000
	set -e; for b in closed_loop reception people sees r2h_v3; do $(BIN)/python bench/$$b.py; done
	set -e; for b in robots robustness; do $(BIN)/python bench/$$b.py --out $(BENCH_RUNS)/$$b; done
	$(if $(RELEASE),$(BIN)/python bench/release.py --release $(RELEASE) --json bench/results/release.json,@echo "bench: without RELEASE=checkout bench/results/release.json stays as it is")
	$(if $(VENDORS),$(BIN)/python bench/vendors.py --files $(VENDORS) --out $(BENCH_RUNS)/vendors --json bench/results/vendors.json,@echo "bench: without VENDORS=folder bench/results/vendors.json stays as it is")
	$(if $(SCANNED),$(BIN)/python bench/scans.py $(SCANNED) --about bench/scanned.toml,@echo "bench: without SCANNED=folder of the meshes of bench/scanned.toml bench/results/scanned.json stays as it is")
	$(if $(SCANS),$(BIN)/python bench/scans.py $(SCANS) --about bench/scans.toml,@echo "bench: without SCANS=folder of the meshes of bench/scans.toml bench/results/scans.json stays as it is")
	$(if $(ARMS),$(BIN)/python bench/registry_arms.py --fetch --packages $(ARMS) --out $(BENCH_RUNS)/arms --json bench/results/registry_arms.json,@echo "bench: without ARMS=folder for packages of PyPI bench/results/registry_arms.json stays as it is")
	$(BIN)/python bench/tables.py --render
	$(BIN)/python bench/figures.py --write
	$(BIN)/python bench/figures.py

stale:  ## lists the figures whose measured source has changed
	@$(BIN)/python bench/figures.py


watch: $(VENV)/.installed-test  ## has this commit become slower than another? by turns, in 6 minutes (BASE=commit)
	$(BIN)/python bench/watch.py $(or $(BASE),HEAD~1)

gpu: $(VENV)/.installed-test  ## everything that a machine with a GPU can show, into runs/gpu (MINUTES=25)
	$(BIN)/python bench/gpu.py --out runs/gpu --minutes $(or $(MINUTES),25)

wheel: $(VENV)/.installed-test  ## wheel and sdist in build/dist, checked; the wheel installed and tried in an empty environment
	rm -rf build/dist build/empty build/lib build/bdist*
	$(BIN)/python -m build --no-isolation --outdir build/dist . >/dev/null
	$(BIN)/python -m twine check --strict build/dist/*
	du -h build/dist/*
	$(PYTHON) -m venv build/empty
	build/empty/bin/python -m pip install -q --no-compile -c constraints.txt build/dist/*.whl
	cd build/empty && bin/r2h-batch sweep --method random --trials 2 --out run
	rm -rf build/empty build/lib build/bdist*

lock: $(VENV)/.installed-test  ## rewrites constraints.txt from what is installed: every package, exact versions
	$(BIN)/python tools/supply.py lock

licences: $(VENV)/.installed-test  ## rewrites docs/licences.md: bundled data and every package with its licence
	$(BIN)/python tools/supply.py licences

audit:  ## known advisories against constraints.txt, where a source is reachable
	$(PYTHON) -m venv $(VENV)-audit
	$(VENV)-audit/bin/python -m pip install -q pip-audit
	$(VENV)-audit/bin/python tools/supply.py audit

clean:  ## removes the virtual environment and what was built
	rm -rf $(VENV) $(VENV)-audit build *.egg-info
