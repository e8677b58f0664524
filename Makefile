# `make drive` and `make test` do all the set-up themselves.

PYTHON ?= $(shell for p in python3 python3.14 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
BIN := .venv/bin
READY := .venv/ready
# What a drive needs; `make test` and the rest add to it. Modules are compiled when they are imported.
DRIVES := .venv/drives

.PHONY: drive test check accuracy recovery how-true estimation corners hostile bench notebook sb3 bags browser clean

drive: $(DRIVES)
	$(BIN)/countersteer drive box

test: $(READY)
	$(BIN)/python tests/run.py

check: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

accuracy: $(READY)
	$(BIN)/python -m benchmarks.accuracy docs/accuracy.md

# Twenty fits: six minutes or more on two cores.
recovery: $(READY)
	$(BIN)/python -m studies.recovery docs/recovery.md

# Every log of ../shared/data with three predictions: five minutes on two cores.
how-true: $(READY)
	$(BIN)/python -m studies.how_true docs/how_true.md

# Some twenty programs to compile, then 256 cars in each: ten minutes or more on two cores.
estimation: $(READY)
	$(BIN)/python -m studies.estimation docs/estimation.md

# Corners of 60 to 180° to both hands, 500 cars each: a table, in a few minutes.
corners: $(READY)
	$(BIN)/python -m studies.corners

# Random cars, damaged files, killed commands, nonsense to the cockpit: half an hour on two cores.
hostile: $(READY)
	$(BIN)/python -m studies.fuzz_physics
	$(BIN)/python -m studies.fuzz_files
	$(BIN)/python -m studies.kills
	$(BIN)/python -m studies.cockpit_hostile

bench: $(READY)
	$(BIN)/python -m benchmarks.speed docs/speed.md

# PyTorch is 200 MB: only the test of Stable-Baselines3 needs it, and skips without.
sb3: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check \
		--constraint constraints.txt --editable '.[dev,sb3]'

# Only who imports bags of ROS needs the library that reads them; its tests skip without.
bags: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check \
		--constraint constraints.txt --editable '.[dev,bags]'
# A test opens the report in Chromium, which has to be there; it skips without either.
browser: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check \
		--constraint constraints.txt --editable '.[dev,browser]'

# Jupyter is some thirty packages: only who changes the notebook needs it.
notebook: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check \
		--constraint constraints.txt --editable '.[notebook]'
	$(BIN)/python -c "import sys, nbclient, nbformat; name = sys.argv[1]; \
		book = nbformat.read(name, 4); \
		nbclient.NotebookClient(book, record_timing=False).execute(); \
		[cell.update(outputs=[o for o in cell.outputs if o.get('name') != 'stderr']) \
		for cell in book.cells if cell.cell_type == 'code']; \
		nbformat.write(book, name)" examples/drift.ipynb
	$(BIN)/ruff format examples/drift.ipynb

$(DRIVES): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is needed: make PYTHON=..."; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile \
		--constraint constraints.txt --editable .
	@# Python 3.11 puts it into each environment, where nothing needs it.
	@$(BIN)/python -m pip uninstall --quiet --yes setuptools 2>/dev/null || true
	@# Tests of others: 20 MB that no drive loads.
	@find .venv/lib -path '*/site-packages/scipy/*' -name tests -prune -exec rm -r {} +
	@find .venv/lib -path '*/site-packages/matplotlib/tests' -prune -exec rm -r {} +
	@touch $(DRIVES)

$(READY): $(DRIVES)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check \
		--constraint constraints.txt --editable '.[dev]'
	@$(BIN)/python -m compileall -q -j 0 .venv/lib >/dev/null || true
	@touch $(READY)

clean:
	rm -rf .venv build src/*.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
