# make demo   the main job end to end, report in demo/report.html
# make table  the paper's table, some hours, page in table/report.html
# make test   the default test suite (five to ten minutes on 2 cores)
# make docs   the documentation site, tutorials executed, in docs/_build/html (extra `docs`)
# make check  lint, types, import directions (fast)
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
ROOMS := acquisition calibration campaign checks diagnosis generator lab materials observers pod reports segmentation spectra
READY := $(VENV)/.ready

.PHONY: demo table discrepancy docs wheel-check bounds-check lock stories test test-slow test-gpu test-page validation validation-input validation-generator validation-prediction validation-simulators starter blind-check benchmark benchmark-memory check format clean

$(READY): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip || echo "pip stays as it is"
	for try in 1 2 3 4; do \
	  $(BIN)/python -m pip install --quiet -e '.[segmentation,cluster,explore,fits,dicom,fabio,meshes,zarr,develop]' && break; \
	  test $$try != 4 || exit 1; echo "the install broke off; once more in $$((try * 15)) s (what is complete is kept)"; sleep $$((try * 15)); done
	$(BIN)/python -m pip install --quiet --no-deps 'msfc-ccd==1.2.0' || echo "msfc-ccd could not be had: the test of its camera's frames is skipped"
	touch $(READY)

demo: $(READY)
	OMP_WAIT_POLICY=passive $(BIN)/raytwin demo -o demo

# generated against measured at each exposure, ten networks each; a stopped run goes on
table: $(READY)
	OMP_NUM_THREADS=1 $(BIN)/raytwin table -o table --workers $(shell nproc)

DOCS_READY := $(VENV)/.docs-ready

$(DOCS_READY): $(READY) pyproject.toml
	$(BIN)/python -m pip install --quiet -e '.[docs]'
	touch $(DOCS_READY)

# a warning is an error; a notebook that fails stops the build
docs: $(DOCS_READY)
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo "open docs/_build/html/index.html"

# the wheel alone, without extras, in an environment of its own: it answers, and no heavy extra came along
wheel-check: $(READY)
	rm -rf build/wheel && mkdir -p build/wheel
	$(BIN)/python -m build --wheel --outdir build/wheel . > build/wheel/build.log 2>&1 || { cat build/wheel/build.log; exit 1; }
	$(PYTHON) -m venv build/wheel/venv
	build/wheel/venv/bin/python -m pip install --quiet build/wheel/*.whl
	cd build/wheel && venv/bin/raytwin info
	cd build/wheel && venv/bin/raytwin predict virtual_lab --kv 60 --filter Cu:0.1 --power-w 30 --exposure-ms 20
	cd build/wheel && venv/bin/raytwin pod $(CURDIR)/tests/pod_examples/hdbk_ex3.csv
	cd build/wheel && venv/bin/python -c "import importlib.util as u; assert u.find_spec('torch') is None and u.find_spec('sphinx') is None"

# the oldest and the newest libraries that pyproject.toml allows, each in an environment of its own; half an hour
bounds-check:
	PYTHON=$(PYTHON) .ci/bounds oldest newest

# the versions that `Containerfile` installs; again after a change of pyproject.toml
lock: $(READY)
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/python -m uv pip compile --quiet --universal --python-version 3.11 --no-header --no-annotate --extra explore --extra fits --extra dicom --extra fabio --extra meshes --extra zarr pyproject.toml -o requirements.lock

# `check` has run tests/test_house.py
test: $(READY) check
	$(BIN)/python -m pytest -q -n 2 --dist worksteal -m 'not slow and not browser' --ignore=tests/test_house.py

# the page of `raytwin explore` and the pages of results in Debian's Chromium (apt-get install chromium), some minutes;
# after `make demo` the demo's page too
test-page: $(READY)
	$(BIN)/python -m pip install --quiet playwright
	$(BIN)/python -m pytest -q -m browser tests/test_explore_page.py tests/test_reports.py tests/test_campaign_*.py

# what takes minutes: some twenty on 2 cores
test-slow: $(READY)
	$(BIN)/python -m pytest -q -n 2 --dist worksteal -m slow

# answers against the virtual lab's truth; minutes (`--help` of each script has its options)
validation: $(READY)
	$(BIN)/python validation/calibration_coverage.py --seeds 40 --json build/calibration_coverage.json
	$(BIN)/python validation/generated_against_lab.py --seeds 3 --json build/generated_against_lab.json
	$(BIN)/python validation/gvxr_transmission.py
	$(BIN)/python validation/reference_transfer.py --json build/reference_transfer.json
	$(BIN)/python validation/effects_against_lab.py --json build/effects_against_lab.json

# sessions broken on purpose, and damaged files, through the command line: an hour
validation-input: $(READY)
	OMP_NUM_THREADS=1 $(BIN)/python validation/broken_sessions.py --json build/broken_sessions.json
	OMP_NUM_THREADS=1 $(BIN)/python validation/damaged_files.py --cases 10000 --json build/damaged_files.json

# generated frames against the lab's: statistics and classifiers, figures in build/generator_vs_lab; half an hour a system
validation-generator: $(READY)
	for seed in 0 2; do $(BIN)/python validation/generator_vs_lab.py --seed $$seed --output build/generator_vs_lab/$$seed --json build/generator_vs_lab/$$seed.json || exit 1; done

# predictions against truth and against the information limit: hours; a stopped run goes on where it was
validation-prediction: $(READY)
	for kind in nominal departing coarse; do OMP_NUM_THREADS=1 $(BIN)/python validation/prediction_limit.py --kind $$kind --processes 2 --next 20 --json build/prediction_limit/$$kind.json || exit 1; done
	for kind in nominal departing; do OMP_NUM_THREADS=1 $(BIN)/python validation/prediction_limit.py --kind $$kind --repeats 3 --first 2000 --systems 40 --processes 2 --json build/prediction_limit/$${kind}_repeated.json || exit 1; done
	OMP_NUM_THREADS=1 $(BIN)/python validation/foreign_lines.py --processes 2 --json build/foreign_lines/coverage.json

# the diagnosis on sessions of other programs, a quarter of an hour a line (gvxr and gecatsim are installed apart; without one its lines are left out)
validation-simulators: $(READY)
	for line in usual coarse hard soft three even counting threshold; do OMP_NUM_THREADS=1 $(BIN)/python validation/second_simulator.py --line $$line --json build/second_simulator_$$line.json || exit 1; done
	for line in csi gos "flat panel"; do OMP_NUM_THREADS=1 $(BIN)/python validation/catsim_sessions.py --line "$$line" --json "build/catsim_$$line.json" || exit 1; done
	for line in curved points areas; do OMP_NUM_THREADS=1 $(BIN)/python validation/gvxr_sessions.py --line $$line --json build/gvxr_$$line.json || exit 1; done
	$(BIN)/python validation/export_in_simulators.py --json build/export_in_simulators.json

# how far laws of a kind depart from ours, for diagnosis/inference/discrepancy.toml, and how far strengths are off: an hour on one core
discrepancy: $(READY)
	for line in usual coarse; do OMP_NUM_THREADS=1 $(BIN)/python validation/learn_discrepancy.py --line $$line --families --seed 15001 --json build/discrepancy/$${line}_families.json || exit 1; done
	OMP_NUM_THREADS=1 $(BIN)/python validation/lab_effects.py --seed 2900 --json build/discrepancy/lab_2900.json
	$(BIN)/python validation/learn_discrepancy.py --learn build/discrepancy/*.json
	$(BIN)/python validation/lab_effects.py --strengths build/discrepancy/lab_*.json

# the diagnosis on sealed cases, hours: `make blind-check SEED=...` with one that nobody has looked at; a stopped run goes on
CASES ?= 600
blind-check: $(READY)
	@test -n "$(SEED)" || { echo "say which seed: make blind-check SEED=123456 [CASES=600]"; exit 2; }
	$(BIN)/raytwin blind-check -n $(CASES) --seed $(SEED) -o build/blind_$(SEED) --train-cases 300 --workers 2

# the worked stories of docs/stories, ten minutes each; what they write stands in build/stories
stories: $(READY)
	for story in scatter drift_and_lag spectrum tie; do \
	mkdir -p build/stories/$$story && \
	(cd build/stories/$$story && PATH=$(CURDIR)/$(BIN):$$PATH sh $(CURDIR)/docs/stories/$$story.sh) || exit 1; done

# kernels, training, ensembles and detection on a CUDA device, against the processor; skipped where there is none
test-gpu: $(READY)
	CUBLAS_WORKSPACE_CONFIG=:4096:8 $(BIN)/python -m pytest -q -m gpu tests/test_gpu.py

# the starter network again, from data/starter/starter.toml; about an hour on one core; a stopped run goes on
starter: $(READY)
	OMP_NUM_THREADS=1 $(BIN)/python -m raytwin.campaign.starter --folder build/starter

# speed and memory as this machine has them, each against its reference in the same run
benchmark: $(READY)
	$(BIN)/python benchmarks/predict_settings.py
	$(BIN)/python benchmarks/frame_sums.py
	OMP_WAIT_POLICY=passive $(BIN)/python benchmarks/generate_pair.py
	OMP_WAIT_POLICY=passive $(BIN)/python benchmarks/project_polychromatic.py
	$(BIN)/python benchmarks/cost_table.py
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/ensemble.py
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/training_step.py
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/pod_bootstrap.py

# peak memory of calibrate at full size, 500 and 5000 frames: 7.3 GB of disk for a while, five minutes
benchmark-memory: $(READY)
	$(BIN)/python benchmarks/calibrate_memory.py

# mypy sees the rooms as raytwin.<room> through a folder of links, without an install
check: $(READY)
	$(BIN)/ruff check src $(ROOMS) tests validation benchmarks docs/_ext docs/conf.py
	$(BIN)/ruff format --check src $(ROOMS) tests validation benchmarks docs/_ext docs/conf.py
	rm -rf build/types && mkdir -p build/types/raytwin
	ln -s $(CURDIR)/src/raytwin/* build/types/raytwin/
	for room in $(ROOMS); do ln -s $(CURDIR)/$$room build/types/raytwin/$$room; done
	MYPYPATH=build/types $(BIN)/mypy --strict -p raytwin
	$(BIN)/python -m pytest -q tests/test_house.py -m 'not slow and not browser'

format: $(READY)
	$(BIN)/ruff check --fix src $(ROOMS) tests validation benchmarks docs/_ext docs/conf.py
	$(BIN)/ruff format src $(ROOMS) tests validation benchmarks docs/_ext docs/conf.py

clean:
	rm -rf $(VENV) build dist *.egg-info demo docs/_build docs/generated docs/jupyter_execute
