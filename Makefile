# `make setup` is idempotent: apt packages when root, then a .venv with Seamark and everything it needs.
SHELL := /bin/bash
PYTHON ?= python3.11
VENV := .venv
STAMP := $(VENV)/.seamark-installed
NATIVE_STAMP := $(VENV)/.seamark-native

.PHONY: setup demo test check lint types contracts lock messages clean
setup: $(NATIVE_STAMP)

$(STAMP): requirements.lock pyproject.toml docker/apt.sh
	bash docker/apt.sh
	$(PYTHON) -m venv --upgrade-deps $(VENV) || { echo "seamark: Python 3.11 with venv is needed (Debian: apt-get install python3.11-venv)" >&2; exit 1; }
	$(VENV)/bin/python -m pip install --quiet --no-deps --require-hashes -r requirements.lock
	$(VENV)/bin/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

# The kernels lie beside their rooms, where the editable installation finds them.
$(NATIVE_STAMP): $(STAMP) CMakeLists.txt $(wildcard vocab/native/* frontend/native/*)
	cmake -S . -B build/native -G Ninja --log-level=WARNING -DPython_EXECUTABLE=$(abspath $(VENV))/bin/python
	cmake --build build/native -- --quiet
	cmake --install build/native --prefix src >/dev/null
	touch $@

demo: setup
	$(VENV)/bin/seamark demo --out demo

test: setup
	$(VENV)/bin/pytest

check: lint types contracts test

lint: setup
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .

types: setup
	$(VENV)/bin/mypy

contracts: setup
	$(VENV)/bin/lint-imports

# For developers of Seamark: needs uv. The locks name no host; hashes guard what is downloaded.
COMPILE := uv pip compile --quiet --universal --python-version 3.11 --no-header --no-annotate --generate-hashes
lock:
	$(COMPILE) --group sim --group dev pyproject.toml -o requirements.lock
	$(COMPILE) pyproject.toml -c requirements.lock -o docker/requirements.lock

messages: setup
	$(VENV)/bin/python -m grpc_tools.protoc -I service --python_out=service --pyi_out=service service/messages.proto

clean:
	rm -rf $(VENV) build dist demo vocab/_native*.so frontend/_native*.so .mypy_cache .ruff_cache .pytest_cache
