# Everything is set up by the targets themselves: CPython 3.11 or newer, pip and make are enough.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
# What a demo needs alone: a tenth of the developers' tools.
USABLE := $(VENV)/.usable

.PHONY: demo test test-long lint types format wheel bench study study-imu study-metrology \
	study-metrology-coverage study-starts study-nist study-loop \
	study-motion study-flights study-inputs study-records study-halves study-asked study-slow study-coverage \
	study-deceptive study-deceptive-many study-fleet study-mutation study-worlds study-noises study-tables \
	study-structural study-check study-plans study-equations study-equations-coverage study-frictions \
	study-told-apart study-sequential study-mag-gyro study-mag-imu \
	figures docs clean

demo: $(USABLE)
	$(BIN)/casest demo

# Compiled modules and tests are kept whatever the environment says: a hundred processes start here.
test: $(READY)
	PYTHONDONTWRITEBYTECODE= OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -n 2 --dist loadfile -rs

# What is too dear to run at every change: whole loops on measured records, counts, Ctrl-C, restarts.
test-long: $(READY)
	PYTHONDONTWRITEBYTECODE= OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -n 2 --dist loadfile -rs -m long

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)
	$(BIN)/mypy

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

wheel: $(READY)
	$(BIN)/python -m build --wheel

bench: $(READY)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/evaluate.py
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/wheel_solve.py
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/many.py
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/fleet.py
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/long.py
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/motion.py
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/motion_long.py
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/equations.py

study: $(READY)
	$(BIN)/python studies/bound.py
	$(BIN)/python studies/wheel_bound.py

study-imu: $(READY)
	$(BIN)/python studies/imu.py

study-starts: $(READY)
	$(BIN)/python studies/random_starts.py

study-nist: $(READY)
	$(BIN)/python studies/nist.py

study-metrology: $(READY)
	$(BIN)/python studies/metrology.py

study-metrology-coverage: $(READY)
	$(BIN)/python studies/metrology_coverage.py

study-coverage: $(READY)
	$(BIN)/python studies/coverage.py

study-loop: $(READY)
	$(BIN)/python studies/loop.py

study-worlds: $(READY)
	$(BIN)/python studies/loop_worlds.py

study-noises: $(READY)
	$(BIN)/python studies/noises.py

study-tables: $(READY)
	$(BIN)/python studies/tables.py

study-motion: $(READY)
	$(BIN)/python studies/flight.py
	$(BIN)/python studies/flight_loop.py

study-flights: $(READY)
	$(BIN)/python studies/flight_loop.py

study-mag-gyro: $(READY)
	$(BIN)/python studies/mag_gyro.py

study-mag-imu: $(READY)
	$(BIN)/python studies/mag_imu.py

study-inputs: $(READY)
	$(BIN)/python studies/inputs.py

study-asked: $(READY)
	$(BIN)/python studies/asked.py

study-slow: $(READY)
	$(BIN)/python studies/slow.py

study-deceptive-many: $(READY)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python studies/deceptive_many.py

study-deceptive: $(READY)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python studies/deceptive.py

study-halves: $(READY)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python studies/halves.py

study-records: $(READY)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python studies/records.py
	OPENBLAS_NUM_THREADS=1 $(BIN)/python studies/agreement.py
	OPENBLAS_NUM_THREADS=1 $(BIN)/python studies/subsets.py

study-check: $(READY)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python studies/check.py

study-fleet: $(READY)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python studies/fleet_common.py

study-equations: $(READY)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python studies/equations.py

study-frictions: $(READY)
	$(BIN)/python studies/frictions.py

study-equations-coverage: $(READY)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python studies/equations_coverage.py

study-structural: $(READY)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python studies/structural.py

study-plans: $(READY)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python studies/plans.py

study-sequential: $(READY)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python studies/sequential.py

study-told-apart: $(READY)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python studies/told_apart.py

study-mutation: $(READY)
	$(BIN)/python studies/mutation.py

figures: $(READY)
	$(BIN)/python studies/figures.py

docs: $(READY)
	$(BIN)/python docs/picture.py
	OPENBLAS_NUM_THREADS=1 $(BIN)/python docs/gallery.py
	$(BIN)/python docs/notebook.py
	$(BIN)/sphinx-build -q -W --keep-going docs out/docs
	@echo "open out/docs/index.html"

clean:
	rm -rf $(VENV) build dist *.egg-info out

$(USABLE): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --no-compile \
		--constraint requirements.txt --editable .
	touch $@

$(READY): pyproject.toml requirements.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -r requirements.txt
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --editable .
	touch $@ $(USABLE)
