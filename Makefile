# Two commands: `make sweep` runs the thesis sweep on CPU, `make test` tests the library. Both set up .venv first.
# Methods of others come with `make peers`. Those in C++ without a Python package, ANN and nanoflann's dynamic index, are compiled when
# they first run, from Debian's headers: apt-get install g++ libann-dev libnanoflann-dev. Rows say what is missing; nothing else fails.
PYTHON ?= python3
VENV   := .venv
PY     := $(VENV)/bin/python
OUT    ?= out/thesis
# What `make sweep` compares, and on which layouts of Table 6.1; METHODS= LAYOUTS= takes all that the config names, for hours.
METHODS ?= warp,warp-counts,pair-sum,cll,hashgrid-plain,scipy-kdtree,vesin,matscipy,matscipy-neighbours,nvalchemi,freud
LAYOUTS ?= corners,clusters2,clusters5,full
# Of each row of the sweep; five tell how far two runs differ, and go on from what one has measured.
PROCESSES ?= 1
# That the repeats of a row may take [s]; `make sweeps` lets slow methods have all of theirs.
MOST_SECONDS ?= 1
STAMP  := $(VENV)/.installed
# What pip and setuptools say of themselves in every set-up: that there is a newer pip, that root installs, how an editable install works.
PIP    := PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_ROOT_USER_ACTION=ignore PYTHONWARNINGS='ignore:Editable installation' $(PY) -m pip install --quiet
# Where nothing may keep what Python compiles, each of the many processes that tests start compiles JAX anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: sweep sweeps peers notebooks docs test check test-slow mutants lint style clean
.DEFAULT_GOAL := test

$(STAMP): pyproject.toml
	$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(f"jfrnn needs Python >= 3.11, found {v[0]}.{v[1]}: set PYTHON=/path/to/python3") if v < (3, 11) else None'
	$(PYTHON) -m venv $(VENV)
	$(PIP) --upgrade pip
	$(PIP) --no-compile --editable . --group test
	touch $@

sweep: $(VENV)/.wheels
	$(PY) -m experiments run experiments/configs/thesis.toml --out $(OUT) --processes $(PROCESSES) --most-seconds $(MOST_SECONDS) \
	  --methods "$(METHODS)" --layouts "$(LAYOUTS)"
	$(PY) -m experiments report $(OUT)

# Methods of others that install without a compiler, one by one: what has no wheel for this machine is left out.
$(VENV)/.wheels: $(STAMP)
	$(PY) -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["dependency-groups"]["wheels"], sep="\n")' | \
	  while read -r each; do $(PIP) --only-binary :all: "$$each" 2> /dev/null || echo "no wheel of $$each for this machine: left out"; done
	touch $@

# Hours: five processes of each row of Table 6.1, then every other question, into the folders that the notebooks read.
SWEEPS := orientation motion cluster_size domain cutoff order size size_large fill
sweeps: $(STAMP)
	$(PY) -m experiments run experiments/configs/thesis.toml --out experiments/results/thesis_cpu
	$(PY) -m experiments report experiments/results/thesis_cpu
	for each in $(SWEEPS); do \
	  $(PY) -m experiments run experiments/configs/sweep_$$each.toml --out experiments/results/sweep_$$each && \
	  $(PY) -m experiments report experiments/results/sweep_$$each || exit 1; done

peers: $(STAMP)
	$(PIP) --group peers

# The notebooks that read rows of sweeps, with their outputs.
notebooks: $(STAMP)
	cd notebooks && for each in thesis_reproduced open_questions gpu_layouts speed_against_error; do \
	  ../$(VENV)/bin/jupyter execute --inplace $$each.ipynb || exit 1; done

# The pages of docs/, in out/docs; what is wrong in them is an error.
docs: $(STAMP)
	$(PY) -m sphinx -W --keep-going docs out/docs
	@echo out/docs/index.html

# The library, whole: every engine, dtype, option and hard case against the oracle. What XLA compiled is kept in .cache for the next run.
test: $(STAMP)
	$(PY) -m pytest --ignore tests/release

# What a release needs besides. Types of the library are checked by a test, beside the others; `make lint` checks those of experiments, too.
check: style
	$(PY) -m pytest tests/release

test-slow: $(STAMP)
	$(PY) -m pytest -m slow

# Faults of one line, each put into a copy: which of them do the tests of `make test` not notice?
mutants: $(STAMP)
	$(PY) tests/mutate.py $(ROOMS)

lint: style
	$(VENV)/bin/pyright

style: $(STAMP)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/clang-format --dry-run -Werror kernels/native/*/*

clean:
	rm -rf $(VENV) .cache out build docs/api/objects docs/notebooks docs/pictures *.egg-info
