# Every target is one command; what it needs comes with it.
SCALE ?= smoke
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: setup lock lowest demo test check tables numbers bench docs nightly

setup: $(VENV)/stamp

$(VENV)/stamp: pyproject.toml requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "error: $(PYTHON) is older than 3.11; use make PYTHON=python3.11"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -r requirements.lock -e '.[dev]'
	@touch $@

lock:
	$(BIN)/python tools/lock.py

# The oldest versions that pyproject.toml allows, in an environment of their own: what uses them most is tried.
lowest: setup
	$(BIN)/pip install --quiet --disable-pip-version-check 'uv>=0.9'
	$(BIN)/uv venv --quiet --clear .cache/lowest
	$(BIN)/uv pip install --quiet --python .cache/lowest/bin/python --resolution lowest-direct -e '.[dev,view,video]'
	.cache/lowest/bin/pytest -p no:cacheprovider tests/test_journal.py tests/test_tensors.py tests/navigation tests/evaluation \
		tests/deploy tests/gym tests/report tests/experiment/test_spec.py tests/robot/test_g1.py tests/safety \
		--deselect tests/evaluation/paired/test_rows.py::test_reading_does_not_import_pandas # PyArrow did, then

demo: setup
	$(BIN)/romnav --results .cache/demo run ablation spawn-goal --scale smoke

test: setup
	$(BIN)/pytest

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

tables: setup
	$(BIN)/romnav tables --scale $(SCALE)

bench: setup
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[bench]'
	$(BIN)/romnav bench

docs: setup
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

nightly: setup
	$(BIN)/romnav --results .cache/nightly run ablation spawn-goal --scale $(SCALE) --no-resume
	$(BIN)/romnav --results .cache/nightly check --scale $(SCALE)
	$(BIN)/pytest -m slow
	$(MAKE) lowest
	$(BIN)/python benchmarks/faults.py --out .cache/nightly/bench

numbers: setup
	$(BIN)/python tools/numbers_in_pages.py
