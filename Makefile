# make setup | demo | lint | test | assets | fuzz | faults | sanitize | clean.  PYTHON chooses the interpreter that .venv is made of.
PYTHON ?= python3
BIN := .venv/bin
NATIVE := $(wildcard p2gs/native/*.cpp p2gs/native/*.h p2gs/native/*.inc)
PLATLIB = $(shell $(BIN)/python -c "import sysconfig; print(sysconfig.get_path('platlib'))")
# Idle threads of torch spin by default, on cores that the kernels want.
export OMP_WAIT_POLICY ?= passive

.PHONY: setup setup-dev native demo lint test assets faults fuzz sanitize clean

setup: .venv/.built

setup-dev: .venv/.dev .venv/.built

# torch first and pinned: everything else must fit it, not the other way round
.venv/.deps: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/pip install -q -c constraints.txt torch
	$(BIN)/pip install -q -c constraints.txt -e .
	touch $@

.venv/.dev: .venv/.deps
	$(BIN)/pip install -q -c constraints.txt -e ".[dev]"
	touch $@

# What p2gs export --check runs, but for node's.
.venv/.validate: .venv/.deps
	$(BIN)/pip install -q -c constraints.txt -e ".[validate]"
	touch $@

# Kernels that are newer than the last installation.
.venv/.built: .venv/.deps CMakeLists.txt $(NATIVE)
	test -z "$$(find CMakeLists.txt $(NATIVE) -newer .venv/.deps)" || $(BIN)/pip install -q --no-deps -e .
	touch $@

# The extension alone, in seconds, for work on the C++ (after setup-dev).
native:
	test -e build/native/CMakeCache.txt || cmake -S . -B build/native -DPython_EXECUTABLE=$(CURDIR)/$(BIN)/python >/dev/null
	cmake --build build/native -j 2
	@rm -f $(PLATLIB)/p2gs/_native*  # a running program may have the old one mapped: replace it, never write into it
	@cmake --install build/native --prefix $(PLATLIB) >/dev/null

demo: setup
	$(BIN)/p2gs fit -c configs/demo.yaml
	$(BIN)/p2gs test runs/demo

# Two files of tests at once, each with half of the threads.
test: setup-dev
	$(BIN)/python -m pytest -n 2 --dist loadfile --timeout=300

# Style, layout, types of the rooms that pass, and which way imports point: under a minute.
lint: setup-dev
	$(BIN)/ruff check p2gs tests bench
	$(BIN)/ruff format --check p2gs tests bench
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/python -m pytest -q tests/test_imports.py

# The demo's exports in every simulator and validator that pip and npm have.
assets:
	.ci/assets

# Kills, full disks, damaged files: KILLS is how many times a run is killed. Hours at 100.
faults: setup-dev
	P2GS_KILLS=$(or $(KILLS),100) $(BIN)/python -m pytest -m slow -s tests/faults

# 2,000 damaged scenes, configs, twins and checkpoints (make test has 200).
fuzz: setup-dev
	$(BIN)/python -m pytest -m slow tests/fuzz

# The tests of the kernels with address and undefined-behaviour sanitizers.
sanitize: setup-dev
	cmake -S . -B build/sanitize -DP2GS_SANITIZE=ON -DCMAKE_BUILD_TYPE=None -DPython_EXECUTABLE=$(CURDIR)/$(BIN)/python >/dev/null
	cmake --build build/sanitize -j 2
	LD_PRELOAD="$$(c++ -print-file-name=libasan.so) $$(c++ -print-file-name=libubsan.so)" ASAN_OPTIONS=detect_leaks=0 \
	P2GS_NATIVE_FILE=$$(ls $(CURDIR)/build/sanitize/_native*) $(BIN)/python -m pytest --timeout=600 tests/native tests/render tests/ops/test_assign.py tests/ops/test_blend.py tests/ops/test_pixels.py tests/ops/test_planar.py tests/ops/test_repel.py tests/models/test_part_pull.py

clean:
	rm -rf .venv build dist wheelhouse runs .pytest_cache .ruff_cache .hypothesis
