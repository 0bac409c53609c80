BENCHMARKS := $(shell grep -l '^def main' benchmarks/*.py)
.PHONY: install demo docs tutorial test pytest pytest-quadrants lint benchmark blender clean $(BENCHMARKS)

BIN := .venv/bin
STAMP := .venv/.installed
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# Python keeps what it has compiled, even where the environment says otherwise: a hundred processes import the library.
export PYTHONDONTWRITEBYTECODE :=

install: $(STAMP)
	@:

$(BIN)/python:
	@for python in "$$PYTHON" python3.11 python3.12 python3.13 python3; do \
	    if "$$python" -c 'import sys, ensurepip, venv; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; then \
	        exec "$$python" -m venv .venv; \
	    fi; \
	done; \
	echo "expected Python 3.11, 3.12 or 3.13 with its venv module, got none on the PATH;" \
	    "install one (Debian, Ubuntu: python3.11-venv) or run: make install PYTHON=/path/to/python3.11" >&2; \
	exit 2

$(STAMP): pyproject.toml constraints.txt | $(BIN)/python
	@echo "Installing into .venv; the first time this downloads about 3 GB and takes a few minutes."
	@$(BIN)/python -m pip install --quiet --constraint constraints.txt setuptools
	@$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --no-build-isolation --editable '.[test]'
	@touch $@

demo: install
	@$(BIN)/probscene demo
	@echo "Everything it made is in the folder demo."

lint: install
	@$(BIN)/ruff check --quiet
	@rm -rf build/types
	@$(BIN)/python -c 'import setuptools; setuptools.setup()' --quiet build_py --build-lib build/types
	@cp -R examples build/types
	@$(BIN)/basedpyright --pythonpath $(BIN)/python

docs: install
	@$(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going --doctree-dir build/doctrees docs build/docs

# Runs the tutorial's code and writes its output and pictures into the page and its notebook.
tutorial: install
	@OMP_NUM_THREADS=1 $(BIN)/python docs/run_page.py docs/tutorials/own_model.md

test: install
	@$(MAKE) --no-print-directory --jobs 3 pytest lint docs pytest-quadrants

# One thread a process: two processes with one thread each are faster than one with two. Without xdist's own order, in
# which files of few tests come last, however long these take. Three for two cores: tests of clusters mostly wait.
pytest: export OMP_NUM_THREADS := 1
pytest: install
	@$(BIN)/python tests/renderers/every_kernel.py >/dev/null  # once, as the engine keeps kernels when a process ends
	$(BIN)/python -m pytest --quiet --numprocesses 3 --dist loadfile --no-loadscope-reorder

# What draws, with the other engine; a test of tests/models compares bytes. Without what takes long, and memory, which
# is not the engine's.
pytest-quadrants: export OMP_NUM_THREADS := 1
pytest-quadrants: export PROBSCENE_ENGINE := quadrants
pytest-quadrants: install
	@$(BIN)/python -m pytest --quiet -p no:cacheprovider tests/renderers \
	    -k 'not (second_process or users_own_engine or memory)'

# An evening's worth. MNIST's files for the benchmarks that need them: make benchmark MNIST=FOLDER
# Two at a time, for what is learnt and not for speed: make --jobs 2 benchmark. A script that fails does not stop others.
benchmark: install
	@$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-build-isolation --editable '.[test,benchmark]'
	@$(MAKE) --no-print-directory --keep-going $(BENCHMARKS)

$(BENCHMARKS): export OMP_NUM_THREADS := 1
$(BENCHMARKS): install
	@echo "$@" && $(BIN)/python $@

# Blender as a Python module, for examples/generators/blender; its wheels are for Python 3.11 alone.
blender:
	@python3.11 -m venv .blender
	@.blender/bin/python -m pip install --quiet 'bpy==5.0.1' 'numpy<2' OpenEXR

clean:
	rm -rf .venv .blender build dist *.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
