# Every target makes the environment it needs (.venv). PYTHON picks the interpreter: make test PYTHON=python3.13
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: help demo test check lint types wheel notebooks bench accuracy fuzz clean

help:
	@echo "make demo       sample data, the main job on it, where to look"
	@echo "make test       the tests"
	@echo "make check      all that CI runs: lint, types, tests, notebooks, wheel"
	@echo "make bench      the benchmarks; writes docs/benchmarks.md"
	@echo "make accuracy   errors of depth, calibration and timing; writes its tables into docs/"
	@echo "make fuzz       hostile inputs for every reader; writes docs/fuzz.md"
	@echo "make notebooks  run the notebooks"
	@echo "make clean      remove environments and products"

$(VENV)/ready: pyproject.toml
	$(PYTHON) -c 'import sys; assert (3, 11) <= sys.version_info < (3, 15), "fusion needs Python 3.11 to 3.14, this is " + sys.version.split()[0]'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet --editable . --group dev
	touch $@

demo: $(VENV)/ready
	rm -rf demo
	$(BIN)/fusion simulate mine demo/mine --duration 1
	$(BIN)/fusion blend demo/mine/rgb demo/mine/fir -o demo/fused --pair stamp --homography demo/mine/truth/homography_5m.toml --preview
	$(BIN)/fusion depth demo/mine/lidar -o demo/depth --rig demo/mine/truth/rig.toml --overlay demo/mine/rgb
	@echo
	@echo "Look at demo/fused/preview.png, at demo/depth/picture/ and demo/depth/overlay/, then at the frames in demo/fused/fused/ and the indexes frames.csv"

test: $(VENV)/ready
	$(BIN)/python -m pytest -n auto --dist loadfile

lint: $(VENV)/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/ready
	$(BIN)/pyright --pythonpath $(BIN)/python

notebooks: $(VENV)/ready
	$(BIN)/python -m pytest --nbmake notebooks --nbmake-timeout=300 -p no:cacheprovider
	$(BIN)/python -m tests.notebooks_are_clean notebooks/*.ipynb

wheel: $(VENV)/ready
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	$(PYTHON) -m venv --clear $(VENV)/clean
	$(VENV)/clean/bin/python -m pip install --quiet dist/*.whl
	cd $(VENV)/clean && bin/python -I $(CURDIR)/tests/wheel_is_sound.py $(CURDIR)/dist
	cd $(VENV)/clean && bin/fusion --help && bin/fusion datasets list

check: lint types test notebooks wheel

bench: $(VENV)/ready
	$(BIN)/python benchmarks/bench.py --write docs/benchmarks.md

accuracy: $(VENV)/ready
	$(BIN)/python benchmarks/accuracy.py --write docs

fuzz: $(VENV)/ready
	$(BIN)/python benchmarks/fuzz.py --write docs/fuzz.md

clean:
	rm -rf $(VENV) demo dist .pytest_cache .ruff_cache .hypothesis
