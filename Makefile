# `make demo` builds the template of the embedded fixture and writes a report; `make test` runs the tests.
# Both make the virtual environment they need. Python 3.11+, a C++17 compiler and make are all that must be there.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
RUN ?= runs/demo
NATIVE := $(wildcard smplxpp/native/*/*.cpp smplxpp/native/*/*.hpp)
# Where torch comes from; empty: PyPI, whose build for Linux brings CUDA. Without a GPU:
# make demo TORCH_INDEX=https://download.pytorch.org/whl/cpu
TORCH_INDEX ?=

# Bytecode is written when a module is first imported, even where the environment says otherwise: of 20,000 files a run needs
# a tenth, and every process would compile it again.
export PYTHONDONTWRITEBYTECODE :=

# Packages with the hashes of their files, so that what is installed is what was tested.
PIP := $(BIN)/pip install --quiet --no-compile
LOCKED := $(PIP) --require-hashes --no-deps -r

.PHONY: demo test test-long test-slow test-fuzz sanitize coverage lint lock bench fixture wheel docs clean

# What compiles the native library comes first, so that it is compiled while the other packages are unpacked.
$(STAMP): pyproject.toml locks/build.lock locks/test.lock CMakeLists.txt $(NATIVE)
	test -d $(VENV) || $(PYTHON) -m venv $(VENV)
	$(LOCKED) locks/build.lock
	$(MAKE) --no-print-directory -j2 $(VENV)/.packages $(VENV)/.native
	touch $(STAMP)

# torch alone has no hash, nor what its builds for CUDA bring: there is a build for every index.
$(VENV)/.packages: locks/test.lock
	$(LOCKED) locks/test.lock
	$(PIP) $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX)) "$$(grep '^torch==' constraints.txt)"
	touch $@

$(VENV)/.native: pyproject.toml CMakeLists.txt $(NATIVE)
	$(PIP) --no-deps --no-build-isolation -e .
	touch $@

# Writes locks/ anew: the versions of constraints.txt, the newest of what these need, and the hashes of all their files.
LOCK = $(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate --no-header \
	-c constraints.txt
lock: $(STAMP)
	$(BIN)/pip install --quiet -c constraints.txt uv
	mkdir -p locks build
	$(LOCK) pyproject.toml --extra avatar --extra video --extra chat --extra dev --group build -o build/test.lock
	for name in build fixture docs wheel; do $(LOCK) -c build/test.lock --group $$name -o build/$$name.lock; done
	for name in test build fixture docs wheel; do \
		awk '/^[a-z]/ { kept = !/^(torch|triton|nvidia-|cuda-)/ } kept' build/$$name.lock > locks/$$name.lock; done

demo: $(STAMP)
	$(BIN)/smplxpp demo $(RUN)

# One thread a process: two processes of two threads each take twice as long on two cores. A third process fills the time in
# which tests wait for a browser or a server; a fourth costs more in caches than it fills.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder
test: $(STAMP)
	$(PYTEST)

# One test in sixteen takes more than half of the time: those of about a second and more. `.ci/run` runs them after the others.
test-long: $(STAMP)
	$(PYTEST) -m "long and not slow and not fuzz"

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
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 -m "not slow and not fuzz" --cov --cov-report=term

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(STAMP)
	$(BIN)/python -m benchmarks

fixture: $(STAMP)
	$(LOCKED) locks/fixture.lock
	$(BIN)/python -m tools.fixture --out data/fixtures/person

# One wheel for every Python from 3.11 on (the native library is loaded with ctypes), then a trial in an environment of its
# own without a compiler.
wheel: $(STAMP)
	$(LOCKED) locks/wheel.lock
	rm -rf build/wheel && mkdir -p build/wheel dist
	$(BIN)/pip wheel --quiet --no-deps --no-build-isolation --wheel-dir build/wheel --config-settings=cmake.define.SMPLXPP_BUNDLE_OPENMP=ON .
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/auditwheel repair --exclude libgomp.so.1 --wheel-dir dist build/wheel/*.whl
	$(BIN)/python -m tools.try_wheel dist/smplxpp-*.whl

# Documentation as a site in build/site, with a reference made of the docstrings; a broken link is an error.
docs: $(STAMP)
	$(LOCKED) locks/docs.lock
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

clean:
	rm -rf $(VENV) build dist *.egg-info
