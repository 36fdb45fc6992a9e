# Everything runs in .venv; only Python 3.11+ and make are needed beforehand.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test check bench docs clean

$(STAMP): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --quiet -e ".[dev]"
	touch $(STAMP)

demo: $(STAMP)
	@echo "The first run compiles for one to two minutes; later ones start at once."
	$(BIN)/rbfmuscle demo --model rbf -o demo_output/rbf
	$(BIN)/rbfmuscle demo --model pbd -o demo_output/pbd
	@echo "Open demo_output/rbf/report.html and demo_output/pbd/report.html"

test: $(STAMP)
	$(BIN)/python -m pytest

check: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m pytest -q tests/contract/test_layers.py

bench: $(STAMP)
	$(BIN)/python -m pip install --quiet -e ".[bench]" || echo "some peers are not to be had; the table says which"
	$(BIN)/python benchmarks/table.py -o benchmarks/last.json
	$(BIN)/python benchmarks/interpolation.py

docs: $(STAMP)
	$(BIN)/python -c "import furo, myst_parser, sphinx" 2>/dev/null || $(BIN)/python -m pip install --quiet -e ".[docs]"
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo "Open docs/_build/html/index.html"

clean:
	rm -rf $(VENV) demo_output docs/_build docs/gallery build *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
