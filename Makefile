# Everything is built in .venv from the two lock files; nothing outside this folder changes.
# A Python other than the newest found:  make install PYTHON=/path/to/python3.12

.PHONY: help install demo test coverage check bench docs dist lock clean
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:

VENV := .venv
BIN := $(VENV)/bin
CREATED := $(VENV)/.created
INSTALLED := $(VENV)/.installed
INSTALLED_DEV := $(VENV)/.installed-dev
DEMO := runs/demo
PYTHON ?=

# pip settings of the user that would send packages elsewhere or change what is installed; certificates, proxies and mirrors stay.
CLEAN_ENV := env -u PYTHONPATH -u PYTHONHOME -u PIP_TARGET -u PIP_PREFIX -u PIP_ROOT -u PIP_USER -u PIP_CONSTRAINT -u PIP_BUILD_CONSTRAINT \
	-u PIP_REQUIREMENT -u PIP_FIND_LINKS -u PIP_PRE -u PIP_DRY_RUN
PIP := $(CLEAN_ENV) $(BIN)/python -m pip --disable-pip-version-check
# Two workers of two threads each would fight for two cores.
ONE_THREAD := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1

# A demo that shows that an installation works, in seconds of processor time.
SHORT := --set identify.refine=false

TEST := $(ONE_THREAD) $(BIN)/python -m pytest -n 2 --benchmark-skip

help:  ## show this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-8s %s\n", $$1, $$2 }' Makefile

install: $(INSTALLED)  ## create .venv with the command kros in it

demo: $(INSTALLED)  ## simulate a population of drives and run the whole study on it
	rm -rf $(DEMO)
	$(BIN)/kros demo --out $(DEMO)

test: $(INSTALLED_DEV)  ## run all tests
	$(TEST)

coverage: $(INSTALLED_DEV)  ## run all tests and measure their branch coverage, which takes half as long again
	$(TEST) --cov --cov-report=term

check: $(INSTALLED_DEV)  ## lint, formatting, types, import layers and circles
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m pytest -q -p no:cacheprovider tests/contract/test_meta_circles.py

bench: $(INSTALLED_DEV)  ## compare every stage with other packages and write docs/benchmarks.md
	@$(PIP) install -q --no-deps --upgrade --target build/peers -r benchmarks/peers.txt || echo "dkpy and slycot could not be installed: they are left out"
	$(ONE_THREAD) PYTHONPATH=build/peers $(BIN)/python -m pytest -q benchmarks --benchmark-only --benchmark-json build/benchmarks.json --benchmark-quiet
	PYTHONPATH=build/peers $(BIN)/python benchmarks/benchmarks_page.py build/benchmarks.json

docs: $(INSTALLED_DEV)  ## build the documentation in docs/_build/html
	$(BIN)/python -m sphinx -W --keep-going -n -q -b html docs docs/_build/html
	@echo "The documentation is in docs/_build/html/index.html"

dist: $(INSTALLED)  ## build wheel and sdist in dist/, and try the wheel in a fresh environment
	rm -rf dist build/tried build/tried-demo
	$(BIN)/python -m hatchling build -d dist
	$(CLEAN_ENV) $(BIN)/python -m venv build/tried
	$(CLEAN_ENV) build/tried/bin/python -m pip --disable-pip-version-check install -q --require-hashes -r requirements.lock
	$(CLEAN_ENV) build/tried/bin/python -m pip --disable-pip-version-check install -q --no-deps dist/*.whl
	cd build && tried/bin/python -m kros --version && tried/bin/kros demo --units 4 --episodes 4 --seconds 10 --out tried-demo $(SHORT)

lock:  ## write both lock files anew from pyproject.toml
	@uv=$$(command -v uv) || { $(FIND_PYTHON); $(CLEAN_ENV) "$$python" -m venv build/uv && build/uv/bin/python -m pip install -q uv && uv=build/uv/bin/uv; }; \
	set -e; \
	$(LOCK) --group build -o requirements.lock; \
	$(LOCK) --group build --group dev -c requirements.lock -o requirements-dev.lock

clean:  ## remove .venv and everything that was built
	rm -rf $(VENV) build dist docs/_build htmlcov .coverage .coverage.* .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis .benchmarks
	find src tests benchmarks examples -name __pycache__ -type d -prune -exec rm -rf {} +

# --upgrade: the newest versions that hold for every supported Python, not those locked before.
# --no-strip-extras: pip takes a pin of "coverage" for none of "coverage[toml]", and a newer coverage for it.
LOCK = $(CLEAN_ENV) "$$uv" pip compile -q --upgrade --universal --fork-strategy fewest --python-version 3.11 --generate-hashes \
	--no-emit-index-url --no-emit-find-links --no-strip-extras --custom-compile-command "make lock" pyproject.toml

# Sets the shell variable `python`, or says what to install. A launcher on the PATH may exist and yet not run, so each is tried.
PYTHONS = $(if $(PYTHON),"$(PYTHON)",python3.13 python3.12 python3.11 python3 python)
define FIND_PYTHON
python=; bare=; \
for candidate in $(PYTHONS); do \
  "$$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 || continue; \
  if "$$candidate" -c 'import venv, ensurepip' >/dev/null 2>&1; then python=$$candidate; break; fi; \
  bare=$${bare:-$$candidate}; \
done; \
if [ -z "$$python" ] && [ -n "$$bare" ]; then \
  version=$$("$$bare" -c 'import sys; print("%d.%d" % sys.version_info[:2])'); \
  echo "$$bare is Python $$version but cannot create virtual environments: its modules venv and ensurepip are not installed." >&2; \
  echo "Install them (Debian, Ubuntu: apt install python$$version-venv), or name another: make install PYTHON=/path/to/python3.12" >&2; exit 1; \
elif [ -z "$$python" ]; then \
  echo "kros needs Python 3.11 or newer; tried:" $(PYTHONS) >&2; \
  echo "Install it (Debian 12, Ubuntu 24.04: apt install python3 python3-venv; Fedora: dnf install python3; macOS: brew install python@3.13)," >&2; \
  echo "or name one that is elsewhere: make install PYTHON=/path/to/python3.12" >&2; exit 1; \
fi
endef

# A changed lock begins from an empty environment, so that nothing stays that is no longer locked.
$(CREATED): requirements.lock requirements-dev.lock
	@$(FIND_PYTHON); echo "Creating $(VENV) with $$python"; $(CLEAN_ENV) "$$python" -m venv --clear $(VENV)
	@touch $@

# The build backend is locked too: nothing is fetched that is not in requirements.lock.
$(INSTALLED): $(CREATED) pyproject.toml
	@echo "Installing kros and the packages of requirements.lock"
	@$(PIP) install -q --require-hashes -r requirements.lock
	@$(PIP) install -q --no-deps --no-build-isolation -e .
	@touch $@

$(INSTALLED_DEV): $(INSTALLED)
	@echo "Installing the packages of requirements-dev.lock"
	@$(PIP) install -q --require-hashes -r requirements-dev.lock
	@touch $@
