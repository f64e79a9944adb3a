# Needs Python 3.11 or newer with venv; everything else comes from the package index into .venv.
PYTHON ?= python3
BIN := .venv/bin
INSTALLED := .venv/.installed

# Other people's readers of our files, for the tests; without npm those tests are skipped.
ORACLES := $(if $(shell command -v npm),tests/web/node_modules/.installed)

.PHONY: demo test bench install clean

demo: install
	$(BIN)/structuregs demo -o runs/demo

test: install $(ORACLES)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright
	$(BIN)/pytest -k any_number_of_threads tests/test_raster_cpu.py tests/test_image_loss.py  # with all threads in one process
	$(BIN)/pytest -n auto --dist worksteal

bench: install
	$(BIN)/python benchmarks/speed.py --against benchmarks/baseline.json

install: $(INSTALLED)

# The stamp is written last: an installation that was interrupted is taken up again.
$(INSTALLED): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

tests/web/node_modules/.installed: tests/web/package-lock.json
	(npm ci --ignore-scripts --no-audit --no-fund --silent --prefix tests/web && touch $@) || echo "npm failed: its tests are skipped"

clean:
	rm -rf .venv runs/demo
