# Everything runs in .venv; only Python 3.11+ and make are needed beforehand.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DEV := $(VENV)/.installed-dev
# Beside a clone's folder Python takes that folder for the package, but where the package itself is on the path. Modules
# are compiled when they are first imported: most never are.
INSTALL := $(BIN)/python -m pip install --quiet --quiet --no-compile --config-settings editable_mode=compat

.PHONY: demo test test-slow test-nojit portability mutants fuzz coverage check bench figures docs release-check clean

$(STAMP): pyproject.toml
	@echo "Installing into $(VENV), about half a minute."
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) -e .
	touch $(STAMP)

$(DEV): $(STAMP)
	$(INSTALL) -e ".[dev]"
	touch $(DEV)

# Both models at once; what the second says is printed when the first is done.
demo: $(STAMP)
	@echo "The first run compiles what it needs, for two minutes; later ones start at once."
	@mkdir -p demo_output
	@$(BIN)/rbfmuscle demo --model pbd -o demo_output/pbd >demo_output/pbd.log 2>&1 & second=$$!; \
	$(BIN)/rbfmuscle demo --model rbf -o demo_output/rbf; code=$$?; \
	wait $$second || code=$$?; grep -v "^phantom: " demo_output/pbd.log; exit $$code
	@echo "Reports: demo_output/rbf/report.html and demo_output/pbd/report.html"
	@echo "Next: $(BIN)/rbfmuscle new examples/meshes"

# A worker for each core (WORKERS=0 for none, as plain pytest has it); whoever is done takes tests from the others.
WORKERS ?= auto
PYTEST := $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal

test: $(DEV)
	$(PYTEST)

# Why each is slow stands beside it.
test-slow: $(DEV)
	$(PYTEST) -m slow

# What the list holds, and why, stands at its top.
test-nojit: $(DEV)
	NUMBA_DISABLE_JIT=1 $(PYTEST) -q $$(grep -v '^#' tests/nojit.txt)

PACKAGES := $(patsubst %/,%,$(sort $(dir $(wildcard rbfmuscle/*/__init__.py)))) pbd_baseline
# Loops count as covered where they run as Python: without compiler; the rest by all tests, child processes included.
coverage: $(DEV)
	NUMBA_DISABLE_JIT=1 $(PYTEST) -q --cov --cov-report= $$(grep -v '^#' tests/nojit.txt)
	$(PYTEST) -q --cov --cov-append --cov-report=term:skip-covered
	@for package in $(PACKAGES); do echo "$$package $$($(BIN)/python -m coverage report --include="$$package/*" --format=total) %"; done

# The numeric tests with vertices moved in their last digits, other processor features, threads and versions, as CI runs
# them. A part, or other variants, by TESTS="tests/implicit tests/muscle" ONLY="haswell oldest".
TESTS ?= tests
portability: $(DEV)
	$(BIN)/python benchmarks/portability.py $(TESTS) $(if $(ONLY),--only $(ONLY))

# Hours on one core; which packages, and how many faults of each, by FAULTS="--packages fibres --count 50".
mutants: $(DEV)
	$(BIN)/python benchmarks/mutants.py $(FAULTS)

# Damaged scenes and meshes by the thousand; ends with a table of what became of them.
fuzz: $(DEV)
	PYTHONPATH=tests $(BIN)/python -m fuzz --scene 10000 --mesh 2000 --frames 250

check: $(DEV)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/mypy
	$(BIN)/python docs/check.py
	$(BIN)/python -m pytest -n 0 --collect-only --quiet --quiet $$(grep -v '^#' tests/nojit.txt) >/dev/null

bench: $(DEV)
	$(BIN)/python benchmarks/interpolation.py

# Measures what the tables of the pages show, writes the JSON files of docs/evidence and the tables from them.
figures: $(DEV)
	$(BIN)/python docs/figures.py --measure

# A wheel and an sdist, installed in a clean environment each, and the phantom hip run there.
release-check: $(DEV)
	$(BIN)/python benchmarks/distributions.py

docs: $(DEV)
	$(BIN)/python -c "import furo, myst_parser, sphinx" 2>/dev/null || $(INSTALL) -e ".[docs]"
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo "Open docs/_build/html/index.html"

clean:
	rm -rf $(VENV) demo_output docs/_build docs/gallery build *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
