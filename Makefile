# Everything runs in .venv, which is made on the first call.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: test slow lint bench ci clean

test: .venv/ready
	$(BIN)/pytest

slow: .venv/ready
	$(BIN)/pytest -m slow

lint: .venv/ready
	$(BIN)/ruff check .

bench: .venv/ready
	$(BIN)/python -m bench.speed
	$(BIN)/python -m bench.accuracy

ci:
	.ci/run

# Editable: the tests then see the sources as they are.
.venv/ready: pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/pip install -q -e '.[dev]'
	touch $@

clean:
	rm -rf .venv build *.egg-info .pytest_cache .ruff_cache
