# Everything runs in .venv, which each target makes from pyproject.toml, without root.
#   make test ARGS="-n 0 -x tests/test_packaging.py"     ARGS goes to pytest, to `flowgraph demo` or to the benches
#   make demo PYTHON=/path/to/python3.12                 the Python that .venv is made from
# Written for GNU make 3.81 and later, the one that macOS has.

VENV := .venv
BIN  := $(VENV)/bin
ARGS ?=
# The first of these that starts and is new enough.
PYTHON ?= $(shell for p in python3.13 python3.12 python3.11 python3; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 && { echo $$p; break; }; done)

# One thread for each process's linear algebra: the matrices are small, and pytest runs several processes.
PYTEST = OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MPLBACKEND=Agg $(BIN)/python -m pytest
WORKERS = -n auto --maxprocesses 4
SOURCES = $(wildcard flowgraph blocks graphs examples tests docs)
TYPED   = $(wildcard flowgraph examples tests)

# The scripts of the pages are made by node from FRONT, and committed: only who changes FRONT needs node.
FRONT = flowgraph/drawing/front
PAGES = flowgraph/drawing/pages

.PHONY: help demo test test-slow lint bench docs site front front-check clean

help:
	@echo "make demo | test | test-slow | lint | bench | docs | site | front | clean"

demo: $(VENV)/.with-xla
	$(BIN)/flowgraph demo --out out $(ARGS)

test: $(VENV)/.with-test
	$(PYTEST) $(WORKERS) $(ARGS)

test-slow: $(VENV)/.with-hardware+test
	$(PYTEST) $(WORKERS) -m slow --durations=20 $(ARGS)

lint: $(VENV)/.with-test
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/lint-imports --no-cache
	$(BIN)/mypy $(TYPED)

bench: $(VENV)/.with-bench+xla+test
	$(BIN)/python -m tests.bench $(ARGS)

docs: $(VENV)/.with-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --config-file $(firstword $(wildcard mkdocs.yml docs/mkdocs.yml) mkdocs.yml) \
		--site-dir $(CURDIR)/out/site

# The site of this version beside those of earlier ones, on the local branch `gh-pages`: publish that.
site: $(VENV)/.with-docs
	PATH="$(CURDIR)/$(BIN):$$PATH" NO_MKDOCS_2_WARNING=1 mike deploy --update-aliases \
		$$($(BIN)/python -c 'from importlib.metadata import version; print(version("flowgraph-filters"))') latest
	$(BIN)/mike set-default latest

# In a copy, so that what npm installs is no part of the package.
front: out/front/.with-node
	cd out/front && npm run --silent check && npm run --silent build -- ../../$(PAGES)

# The committed scripts are those that the source makes.
front-check: out/front/.with-node
	cd out/front && npm run --silent check && npm run --silent build -- made && diff -r made ../../$(PAGES)

out/front/.with-node: $(wildcard $(FRONT)/*.* $(FRONT)/src/*)
	mkdir -p out/front && rm -rf out/front/src out/front/made && cp -R $(FRONT)/. out/front
	cd out/front && npm ci --ignore-scripts --no-audit --no-fund --silent
	touch $@

clean:
	rm -rf $(VENV) out build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# .venv/.with-A+B is there once the extras A and B of this pyproject.toml are installed.
comma := ,
$(VENV)/.with-%: pyproject.toml $(VENV)/.ready
	@echo "Installing flowgraph with [$(subst +,$(comma),$*)] into $(VENV) (the first time takes a few minutes)"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[$(subst +,$(comma),$*)]"
	@touch $@

# .venv/.ready is there once .venv has a pip that can install this project.
# Debian and Ubuntu put venv's own copy of pip in a package apart, and without that package `python3 -m venv` fails.
# Then pip comes from the pip that Python has, else from that package's wheel, which can be had without root.
$(VENV)/.ready:
	@python="$(PYTHON)"; wheel="$(CURDIR)/$(VENV)/pip-wheel"; \
	if [ -z "$$python" ]; then \
		echo "flowgraph needs Python 3.11 or newer, and found none on the path."; \
		echo "  Debian, Ubuntu:  sudo apt-get install python3 python3-venv"; \
		echo "  macOS:           brew install python@3.13"; \
		echo "Or name one:       make $(MAKECMDGOALS) PYTHON=/path/to/python3"; \
		exit 1; \
	elif ! "$$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then \
		echo "flowgraph needs Python 3.11 or newer; PYTHON=$$python is not one."; \
		exit 1; \
	fi; \
	echo "Making $(VENV) with $$("$$python" --version)"; \
	rm -rf $(VENV); \
	if ! "$$python" -m venv $(VENV) >/dev/null 2>&1; then \
		echo "This Python has no pip for $(VENV) (no ensurepip module): looking for another one"; \
		rm -rf $(VENV); \
		"$$python" -m venv --without-pip $(VENV) && mkdir "$$wheel" || exit 1; \
		if "$$python" -m pip --python $(BIN)/python install --quiet pip >/dev/null 2>&1; then :; \
		elif (cd "$$wheel" && apt-get download python3-pip-whl && dpkg-deb -x python3-pip-whl_*.deb .) >/dev/null 2>&1 \
			&& set -- "$$wheel"/usr/share/python-wheels/pip-*.whl && $(BIN)/python "$$1/pip" install --quiet pip; then :; \
		else \
			rm -rf $(VENV); \
			echo "Found none. Please install the missing package, then run make again:"; \
			"$$python" -c 'import sys; print("  sudo apt-get install python3.{}-venv".format(sys.version_info[1]))'; \
			exit 1; \
		fi; \
		rm -rf "$$wheel"; \
	fi; \
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade 'pip>=23' && touch $@
