# Two commands do everything on a fresh machine: `make demo` and `make test`. Neither needs hardware or root.

PYTHON ?= python3
BIN := .venv/bin
# PYTHONWARNINGS: what the build backend thinks of editable installs is no news to whoever types make.
PIP_INSTALL := PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --disable-pip-version-check --retries 5 --timeout 60

# Bytecode is kept: a process of the stage starts 0.2 s sooner, the collection of the tests takes 6 s in place of 14.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: setup demo test check browser-test guest-test bench clean

setup: .venv/.installed

# A virtual environment without pip is one that was interrupted, or a Debian without python3-venv: made anew.
.venv/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "stagectl needs Python 3.11 or newer, and $(PYTHON) is: $$($(PYTHON) --version 2>&1)." >&2; \
	  echo "Install one (Debian, Ubuntu: apt install python3 python3-venv), or name it: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; \
	  exit 1; }
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || { rm -rf .venv && $(PYTHON) -m venv .venv; } || { \
	  rm -rf .venv; \
	  echo "No virtual environment could be made; on Debian and Ubuntu: apt install python3-venv" >&2; \
	  exit 1; }
	@echo "installing into .venv (once; about 1 GB of disk, a minute or two)"
	@$(PIP_INSTALL) --editable '.[dev]' || $(PIP_INSTALL) --editable '.[dev]' || { \
	  echo "The packages could not be installed; what pip says above names the one, or the network." >&2; \
	  exit 1; }
	@touch $@

demo: setup
	$(BIN)/stagectl demo

# What keeps real time has the machine to itself; the rest shares its cores.
test: setup
	$(BIN)/python -m pytest -m 'not real_time' --numprocesses auto --dist loadfile
	$(BIN)/python -m pytest -m real_time

check: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/lint-imports

# The page in a real Chromium: part of `make test` where there is one, a failure here where there is none.
browser-test: setup
	STAGECTL_NEEDS_CHROMIUM=1 $(BIN)/python -m pytest tests/service/test_page_browser.py

# Root: makes a disk image, kept in $XDG_CACHE_HOME/stagectl-guest, and boots it in qemu.
guest-test: setup
	PYTHON=$(CURDIR)/$(BIN)/python tests/guest/run.sh

# What a full run measured (docs/figures-service.md, docs/gap-results.json) is kept: these are the short runs.
bench: setup
	$(BIN)/python -m bench main_job --markdown docs/figures.md
	$(BIN)/python -m bench gap --markdown docs/figures-gap.md
	$(BIN)/python -m bench paper --markdown docs/figures-paper.md
	$(BIN)/python -m bench service --markdown docs/figures-service-part.md

clean:
	rm -rf .venv build dist *.egg-info .pytest_cache .ruff_cache .import_linter_cache .hypothesis
