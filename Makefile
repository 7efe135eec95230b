# Two commands on a fresh machine (Debian 12, Python >= 3.11, make): `make demo` and `make test`.
SHELL := /bin/bash
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.forefield-installed
PYTEST_ARGS ?=
# Processes that run the default tests; a file's tests stay together.
WORKERS ?= 2
# Where pip may look for PyTorch beside its usual index, such as PyTorch's own index of CPU builds.
TORCH_INDEX ?=
# Such as FAULTS_ARGS='--only 1 3 --seed 7': these rows alone; the others stay as they are in the table.
FAULTS_ARGS ?=

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-slow test-docker faults faults-full mutants reference-drive check audit sbom format clean

help: ## Show what can be made
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | column -t -s "$$(printf '\t')"

setup: $(STAMP) ## Create .venv and install everything into it

$(STAMP): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "Forefield needs Python 3.11 or newer; this is $$($(PYTHON) --version). Set PYTHON=..."; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) \
	  || { echo "Cannot make a virtual environment: install it first (Debian: apt-get install python3-venv)"; exit 1; }
	@echo "Installing into $(VENV) (about 1.5 GB, a few minutes the first time) ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX)) -e '.[dev]'
	@touch $@

demo: $(STAMP) ## Run a built-in scenario end to end and record it to runs/demo.rrd
	@mkdir -p runs
	@$(BIN)/forefield run --scenario demo --record runs/demo.rrd --json runs/demo.json

test: $(STAMP) ## Run the default tests (under ten minutes on two cores)
	@$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile $(PYTEST_ARGS)

test-slow: $(STAMP) ## Run the long checks
	@$(BIN)/python -m pytest -m slow --timeout 3600 $(PYTEST_ARGS)

test-docker: $(STAMP) ## Build and run the images on a real Docker engine
	@$(BIN)/python -m pytest -m docker --timeout 1800 $(PYTEST_ARGS)

faults: $(STAMP) ## Break everything on purpose and write the table into docs/safety.md (15 minutes, a quiet machine)
	@$(BIN)/python -m evaluation.faults --json docs/faults.json --markdown docs/safety.md $(FAULTS_ARGS)

faults-full: $(STAMP) ## The same with the full counts (hours)
	@$(BIN)/python -m evaluation.faults --full --json docs/faults.json --markdown docs/safety.md $(FAULTS_ARGS)

mutants: $(STAMP) ## Change codec, health, validator and safe stop in 1700 small ways: do their tests notice? (20 minutes)
	@$(BIN)/python -m evaluation.faults.mutants $(MUTANTS_ARGS)

reference-drive: $(STAMP) ## Renew the recorded drive that the tests repeat (tests/replay)
	@$(BIN)/python -m rig.bus_log.reference tests/replay/reference_drive.mcap

check: $(STAMP) ## Lint, format, types, import contracts
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports

sbom: $(STAMP) ## List what .venv and the built images contain, as CycloneDX in runs/sbom
	@mkdir -p runs/sbom
	@$(BIN)/cyclonedx-py environment $(VENV) --of JSON -o runs/sbom/venv.json
	@for image in $$(docker images --format '{{.Repository}}' 2>/dev/null | grep -x 'forefield-[a-z]*' | sort -u); do \
	  docker run --rm --network none $$image sh -c "python -m pip freeze --all" \
	    | grep -v '^forefield @' | $(BIN)/cyclonedx-py requirements - --of JSON -o runs/sbom/$$image.json \
	  && docker run --rm --network none $$image dpkg-query -W -f '$${Package} $${Version}\n' > runs/sbom/$$image.debian.txt \
	  || exit 1; done
	@for f in runs/sbom/*.json; do echo "$$f: $$(grep -c '"bom-ref"' $$f) components"; done

audit: sbom ## Check the packages of .venv for known vulnerabilities (asks the package index), after listing them
	@$(BIN)/pip freeze --exclude-editable > runs/sbom/venv.txt
	@$(BIN)/pip-audit --strict --progress-spinner off --no-deps --disable-pip -r runs/sbom/venv.txt \
	  || { echo "pip-audit found something, or its index does not tell of vulnerabilities: see the lines above"; exit 1; }

format: $(STAMP) ## Format the code
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

clean: ## Remove what the tools leave behind (not .venv)
	@rm -rf runs dist build .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
