# Everything runs in .venv, which is made on the first call.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: test slow client lint bench ci clean

test: .venv/ready
	$(BIN)/pytest

slow: .venv/ready
	$(BIN)/pytest -m slow

# A real reader of what `atmo-jit export` writes, and `atmo-jit view`, in headless Chromium (which has to be installed).
client: .venv/ready .client/node_modules
	$(BIN)/pytest -m client

.client/node_modules:
	npm install --no-save --prefix .client --legacy-peer-deps --ignore-scripts \
		three@0.180 @takram/three-atmosphere@0.19.1 postprocessing@6.37

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
	rm -rf .venv .client build *.egg-info .pytest_cache .ruff_cache
