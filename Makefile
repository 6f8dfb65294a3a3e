# make setup | demo | test | check | lock
PYTHON ?= python3
BIN := .venv/bin
UV_VERSION := 0.9.30

.PHONY: setup demo test check fresh lock clean

setup: .venv/.done

.venv/.done: requirements.lock pyproject.toml scripts/setup.sh
	PYTHON="$(PYTHON)" UV_VERSION=$(UV_VERSION) bash scripts/setup.sh

demo: setup
	$(BIN)/python scripts/demo.py

test: setup
	bash scripts/test-peers.sh
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -n 2 --dist worksteal

check: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python scripts/generated.py --check

fresh: setup
	$(BIN)/python scripts/generated.py

lock: setup
	$(BIN)/uv pip compile --universal --generate-hashes --no-header --python-version 3.11 requirements.in -o requirements.lock

clean:
	rm -rf .venv build *.egg-info out demo
