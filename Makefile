# Two commands: `make sweep` runs the thesis sweep on CPU, `make test` runs every test. Both set up .venv first.
PYTHON ?= python3
VENV   := .venv
PY     := $(VENV)/bin/python
OUT    ?= out/thesis
STAMP  := $(VENV)/.installed

.PHONY: sweep test test-slow lint clean
.DEFAULT_GOAL := test

$(STAMP): pyproject.toml
	$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(f"jfrnn needs Python >= 3.11, found {v[0]}.{v[1]}: set PYTHON=/path/to/python3") if v < (3, 11) else None'
	$(PYTHON) -m venv $(VENV)
	$(PY) -m pip install --quiet --upgrade pip
	$(PY) -m pip install --quiet --editable '.[test]'
	touch $@

sweep: $(STAMP)
	$(PY) -m experiments run experiments/configs/thesis.toml --out $(OUT)
	$(PY) -m experiments report $(OUT)

test: lint
	$(PY) -m pytest

test-slow: $(STAMP)
	$(PY) -m pytest -m slow

lint: $(STAMP)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/pyright

clean:
	rm -rf $(VENV) out build *.egg-info
