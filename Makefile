# Two commands do everything on a machine with Python 3.11 or 3.12: `make demo` and `make test`.
# All that is installed goes to .venv and .venv-* beside this file. No sudo.

SHELL := /bin/sh
PYTHON ?= $(shell command -v python3.11 || command -v python3.12 || command -v python3)
VENV := .venv
OLDEST := .venv-oldest
RLLIB := .venv-rllib
LEROBOT := .venv-lerobot
CLIENTS := .venv-clients
CHROMIUM ?= /usr/bin/chromium
KERNEL := packages/ur-core/ur_core/kernel/_kernel.so
# The distributions of this repository, which need each other.
EDITABLE := -e packages/ur-core -e packages/ur-emulator -e
PACKAGED := packages/ur-core/pyproject.toml packages/ur-emulator/pyproject.toml
# What is imported is compiled then: compiling all that torch and others bring takes longer than all the rest.
PIP_FLAGS := --quiet --disable-pip-version-check --no-compile
# The tests run the examples that come with ur_rtde's source.
FETCH_EXAMPLES = $(VENV)/bin/python -m pip download --quiet --disable-pip-version-check --no-deps --no-binary :all: ur_rtde==1.6.5 -d
# Small matrices gain nothing from BLAS threads, which would compete with the simulation's own.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
# Some containers set it. The tests start many processes, and each would compile all that it imports again.
unexport PYTHONDONTWRITEBYTECODE

# Tests of a distribution, and folders of packages: in an environment linked from that of all tests, without the others.
ALONE = $(VENV)/bin/python -m tests.alone .venv-$(1) "$(1)[test]" --source $(2) && \
  .venv-$(1)/bin/python -P -m pytest -n 2 --dist worksteal -m "not emulated" -o pythonpath="$(2)" packages/$(1)/tests

# `make fuzz`: executions per target, or seconds (TIME_S=60); some targets only (TARGET=rtde_server); another seed.
RUNS ?= $(if $(TIME_S),0,20000)

.PHONY: help demo dist docs media test test-virtual test-live test-page test-oldest test-rllib test-lerobot test-torchrl clients soak simulate mutants fuzz bench install lint format clean check-python check-python-of-tests

help:  ## this list
	@sed -n 's/^\([a-z-]*\):.*  ## \(.*\)/make \1\t\2/p' Makefile | expand -t 20

check-python:
	@test -n "$(PYTHON)" || { echo "No python3 was found. On Debian or Ubuntu: apt-get install python3 python3-venv"; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 15))' || { \
	  echo "$(PYTHON) is $$($(PYTHON) --version 2>&1): Python 3.11 or 3.12 is needed, or 3.13 or 3.14 without arms."; \
	  echo "On Debian 12: apt-get install python3.11 python3.11-venv. Or name one: make $(MAKECMDGOALS) PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || { \
	  echo "$(PYTHON) cannot make virtual environments. On Debian or Ubuntu: apt-get install python3-venv"; exit 1; }

# Tests need ur_rtde and dm-control, which have no wheels for Python 3.13 and later.
check-python-of-tests: $(VENV)/bin/python
	@$(VENV)/bin/python -c 'import sys; sys.exit(sys.version_info[:2] >= (3, 13))' || { \
	  echo "$(VENV) has $$($(VENV)/bin/python --version 2>&1): the tests need Python 3.11 or 3.12, for ur_rtde and dm-control."; \
	  echo "make clean, then name one: make $(MAKECMDGOALS) PYTHON=/path/to/python3.11"; exit 1; }

$(VENV)/bin/python: | check-python
	@$(PYTHON) -m venv $(VENV)

# What the demo needs: the package, its plots, the emulator, and ur_rtde as its client. No torch. Where ur_rtde cannot be
# installed, the demo says so and shows the rest.
$(VENV)/.demo: pyproject.toml $(PACKAGED) constraints.txt $(VENV)/bin/python
	@echo "Installing dual-ur10 with its plots and ur_rtde into $(VENV) ..."
	@$(VENV)/bin/python -m pip install $(PIP_FLAGS) -c constraints.txt $(EDITABLE) '.[plot,emulator,real]' || { \
	  echo "ur_rtde could not be installed: trying without it."; \
	  $(VENV)/bin/python -m pip install $(PIP_FLAGS) -c constraints.txt $(EDITABLE) '.[plot,emulator,records]'; }
	@touch $@

# What the tests need, too.
$(VENV)/.dev: pyproject.toml $(PACKAGED) constraints.txt $(VENV)/bin/python | check-python-of-tests
	@echo "Installing dual-ur10 with all that its tests need into $(VENV) ..."
	@$(VENV)/bin/python -m pip install $(PIP_FLAGS) -c constraints.txt $(EDITABLE) '.[dev]'
	@$(FETCH_EXAMPLES) $(VENV)/sdist || echo "The examples of ur_rtde could not be fetched: their test is skipped."
	@touch $@ $(VENV)/.demo

# What fuzzing needs beside the package. No torch.
$(VENV)/.fuzz: pyproject.toml $(PACKAGED) constraints.txt $(VENV)/bin/python
	@echo "Installing dual-ur10 with a fuzzer into $(VENV) ..."
	@$(VENV)/bin/python -m pip install $(PIP_FLAGS) -c constraints.txt $(EDITABLE) '.[fuzz]'
	@touch $@

$(OLDEST)/.dev: pyproject.toml $(PACKAGED) constraints-oldest.txt | check-python
	@echo "Installing the oldest supported versions into $(OLDEST) ..."
	@test -x $(OLDEST)/bin/python || $(PYTHON) -m venv $(OLDEST)
	@$(OLDEST)/bin/python -m pip install $(PIP_FLAGS) -c constraints-oldest.txt $(EDITABLE) '.[plot,test]'
	@touch $@

# RLlib pins a Gymnasium of its own choice, and asks for some hundred MB that nothing else needs.
$(RLLIB)/.dev: pyproject.toml $(PACKAGED) constraints-rllib.txt | check-python
	@echo "Installing dual-ur10 with Ray RLlib into $(RLLIB) ..."
	@test -x $(RLLIB)/bin/python || $(PYTHON) -m venv $(RLLIB)
	@$(RLLIB)/bin/python -m pip install $(PIP_FLAGS) -c constraints-rllib.txt $(EDITABLE) '.[rllib]' hypothesis psutil pytest
	@touch $@

# LeRobot asks for Python 3.12 and a PyTorch of its own choice: on Linux, 2.2 GB from the usual index, 5 GB on disk.
LEROBOT_PYTHON ?= $(shell python3.12 -c 'import sys; print(sys.executable)' 2>/dev/null)
PLUGINS := $(addprefix -e integrations/lerobot_,robot_dual_ur10 teleoperator_dual_ur10 env_dual_ur10)
$(LEROBOT)/.dev: pyproject.toml $(PACKAGED) constraints-lerobot.txt $(wildcard integrations/*/pyproject.toml)
	@test -n "$(LEROBOT_PYTHON)" || { echo "LeRobot needs python3.12: install it, or name it: make test-lerobot LEROBOT_PYTHON=/path/to/it"; exit 1; }
	@echo "Installing dual-ur10 with LeRobot into $(LEROBOT) ..."
	@test -x $(LEROBOT)/bin/python || $(LEROBOT_PYTHON) -m venv $(LEROBOT)
	@$(LEROBOT)/bin/python -m pip install $(PIP_FLAGS) -c constraints-lerobot.txt $(EDITABLE) '.[lerobot,teleop,virtual]' $(PLUGINS) pytest
	@touch $@

# Clients of UR controllers by others. One of them needs a NumPy that nothing else takes.
$(CLIENTS)/.dev: constraints-clients.txt | check-python
	@echo "Installing other client libraries into $(CLIENTS) ..."
	@test -x $(CLIENTS)/bin/python || $(PYTHON) -m venv $(CLIENTS)
	@$(CLIENTS)/bin/python -m pip install $(PIP_FLAGS) -r constraints-clients.txt
	@touch $@

# The compiled kernel lies in the package, one for all environments. Each installation compiles it; this does so again
# after a change of its sources. pip brings a compiler where there is none.
$(KERNEL): packages/ur-core/hatch_build.py $(wildcard packages/ur-core/ur_core/kernel/*.?pp) packages/ur-core/ur_core/kernel/flags.txt | $(VENV)/bin/python
	@echo "Compiling the control kernel ..."
	@$(VENV)/bin/python -m pip install $(PIP_FLAGS) --no-deps -e packages/ur-core

install: $(VENV)/.dev $(KERNEL)  ## set up .venv for the tests

demo: $(VENV)/.demo $(KERNEL)  ## install, run scripted and learned policies, also on emulated arms; write out/report.html and videos
	@$(VENV)/bin/python -m demo --out out

test: $(VENV)/.dev $(KERNEL)  ## install, lint, type-check, run all tests but those in real time, and a smoke test of these
	@echo "Lint, types and documentation, and beside them the tests ..."
	@$(MAKE) --no-print-directory -j 3 lint docs test-virtual
	@$(VENV)/bin/python -m pytest tests/live/test_smoke.py

# What make prints last names what has failed. The tests of a distribution run where there is nothing that it does not need.
test-virtual: $(VENV)/.dev $(KERNEL)
	@$(VENV)/bin/python -m pytest -n 2 --dist worksteal -m "not emulated" tests
	@$(call ALONE,ur-core,packages/ur-core)
	@$(call ALONE,ur-emulator,packages/ur-core packages/ur-emulator)

# Streaming to arms asks for more than half of two cores, in real time: these tests run one at a time, with nothing
# beside them. Controllers that wait more than they work come in pairs.
test-live: $(VENV)/.dev $(KERNEL)  ## the tests in real time: processes, sockets and the unmodified ur_rtde client
	@$(VENV)/bin/python -m pytest -m real_time; code=$$?; \
	  $(VENV)/bin/python -m pytest -n 2 -m "emulated and not real_time" || code=$$?; exit $$code

# Debian's Chromium, since playwright's own download needs the network and half a gigabyte.
$(CHROMIUM):
	@if command -v apt-get >/dev/null && test "$$(id -u)" = 0; then \
	  echo "Installing Chromium ..."; apt-get update -qq && apt-get install -y -qq --no-install-recommends chromium >/dev/null; \
	else \
	  echo "The tests of the live page need $(CHROMIUM). On Debian: sudo apt-get install chromium"; \
	  echo "Elsewhere: install Chromium or Chrome, then make test-page CHROMIUM=/path/to/it"; exit 1; fi

# Apart from the rest, since it is 46 MB that no other test needs.
$(VENV)/.browser: $(VENV)/.dev
	@$(VENV)/bin/python -m pip install $(PIP_FLAGS) -c constraints.txt playwright
	@touch $@

# A browser that hangs is ended.
test-page: $(VENV)/.browser $(KERNEL) | $(CHROMIUM)  ## the live page in a real browser, Debian's Chromium
	@CHROMIUM=$(CHROMIUM) $(if $(shell command -v timeout),timeout -k 30 1200) $(VENV)/bin/python -m pytest tests/browser

# What neither steps MuJoCo nor knows Gymnasium is the same with every version of them, and so are stops of the arms:
# the other tests of tests/virtual run emulated cells. Sizes of wheels are those of the newest versions.
SAME_WITH_OLDEST = emulated fuzz test_wheels.py virtual/faults virtual/test_simulation.py virtual/test_point_stream.py \
  $(addprefix sim2real/,calibration links processes trajectory control/test_adapter.py control/test_pipeline.py)

test-oldest: $(OLDEST)/.dev $(KERNEL)  ## the tests that step MuJoCo or know Gymnasium, with MuJoCo 3.17 and Gymnasium 1.2.2
	@$(OLDEST)/bin/python -m pytest -n 2 --dist worksteal -m "not emulated" tests packages/ur-core/tests \
	  $(addprefix --ignore tests/,$(SAME_WITH_OLDEST))

dist: $(VENV)/.dev  ## build wheels and sdists into out/dist, and check each sdist by building from it
	@rm -rf out/dist
	@for each in packages/ur-core packages/ur-emulator .; do $(VENV)/bin/python -m build --outdir out/dist $$each || exit 1; done

# Not --quiet: it hides warnings from --strict as well.
docs: $(VENV)/.dev $(KERNEL)  ## build the documentation site into out/site, strictly
	@found=$$(PYTHONPATH=. NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs build --strict --site-dir out/site 2>&1) || \
	  { echo "$$found" | grep -v '^INFO'; exit 1; }

media: $(VENV)/.dev $(KERNEL)  ## make the videos and pictures of the documentation anew: half an hour without a GPU
	@MUJOCO_GL=$(or $(MUJOCO_GL),egl) PYTHONPATH=. $(VENV)/bin/python docs/media.py
	@$(VENV)/bin/python docs/figures.py
	@$(VENV)/bin/python docs/floors.py

test-torchrl: $(VENV)/.dev $(KERNEL)  ## TorchRL's own wrappers and checks, which `make test` skips without TorchRL
	@$(VENV)/bin/python -m pip install $(PIP_FLAGS) -c constraints.txt torchrl
	@$(VENV)/bin/python -m pytest tests/envs/api/test_torchrl.py tests/test_examples.py -k torchrl

test-rllib: $(RLLIB)/.dev $(KERNEL)  ## training on Ray RLlib with two workers on this machine
	@$(RLLIB)/bin/python -m pytest tests/distributed

test-lerobot: $(LEROBOT)/.dev $(KERNEL)  ## LeRobot's loader, record, replay, eval and rollout with simulated and emulated arms
	@$(LEROBOT)/bin/python -m pytest --confcutdir integrations integrations/tests

clients: $(VENV)/.dev $(CLIENTS)/.dev $(KERNEL)  ## other client libraries against emulated controllers and policy servers; writes the table of docs/reference/clients.md
	@$(VENV)/bin/python benchmarks/clients.py --python $(CLIENTS)/bin/python --page docs/reference/clients.md
	@$(VENV)/bin/python benchmarks/policy_servers.py --python $(CLIENTS)/bin/python

# Properties are the same in every other run. Here they draw anew; a failure prints the decorator that replays it.
soak: $(VENV)/.dev $(KERNEL)  ## the tests with their full counts (about twenty times as long), fresh draws or those of SEED
	@export DUAL_UR10_SOAK=1; seed=$(or $(SEED),$$(od -An -N4 -tu4 /dev/urandom | tr -d ' ')); \
	  echo "Properties are drawn with seed $$seed: make soak SEED=$$seed draws the same."; \
	  $(VENV)/bin/python -m pytest -n 2 -m "not emulated" --hypothesis-seed=$$seed --durations=15; code=$$?; \
	  $(MAKE) --no-print-directory test-live || code=$$?; exit $$code

fuzz: $(VENV)/.fuzz $(KERNEL)  ## fuzz all that reads bytes of others: RUNS=20000 or TIME_S=60 per target, TARGET=name
	@$(VENV)/bin/python -m tests.fuzz.run --runs $(RUNS) --seconds $(or $(TIME_S),0) $(if $(SEED),--seed $(SEED)) $(TARGET)

# The seeds of a failure replay exactly: make simulate SEED=123. Or a schedule from a file: make simulate SCHEDULE=file.toml
simulate: $(VENV)/.dev $(KERNEL)  ## SEEDS random fault schedules on virtual cells, on JOBS processes
	@$(VENV)/bin/python -m tests.virtual.simulate \
	  $(if $(SEED),--seed $(SEED),$(if $(SCHEDULE),--schedule $(SCHEDULE),--seeds $(or $(SEEDS),1000) $(if $(JOBS),--jobs $(JOBS))))

mutants: $(VENV)/.dev $(KERNEL)  ## 30 deliberate breaks of the motion path, each in a copy: the fault simulator must find them
	@$(VENV)/bin/python -m tests.virtual.mutants

bench: $(VENV)/.dev $(KERNEL)  ## all benchmarks, figures to out/*.json
	@mkdir -p out
	@$(VENV)/bin/python benchmarks/kinematics.py --json out/kinematics.json
	@$(VENV)/bin/python benchmarks/planning.py --json out/planning.json
	@$(VENV)/bin/python benchmarks/adapter.py --json out/adapter.json
	@$(VENV)/bin/python benchmarks/exploration.py --json out/exploration.json
	@$(VENV)/bin/python benchmarks/accuracy.py --json out/accuracy.json
	@$(VENV)/bin/python benchmarks/throughput.py --json out/throughput.json
	@$(VENV)/bin/python benchmarks/emulator.py --seconds 60 --json out/emulator.json
	@$(VENV)/bin/python benchmarks/external_control.py --json out/external_control.json
	@$(VENV)/bin/python benchmarks/live_page.py --json out/live_page.json
	@$(VENV)/bin/python benchmarks/cameras.py --json out/cameras.json
	@$(VENV)/bin/python benchmarks/runner.py --json out/runner.json
	@$(VENV)/bin/python benchmarks/real_time.py --json out/real_time.json
	@$(VENV)/bin/python benchmarks/virtual_cell.py --json out/virtual_cell.json
	@$(VENV)/bin/python benchmarks/calibration.py --json out/calibration.json
	@$(VENV)/bin/python benchmarks/followers.py --json out/followers.json
	@$(VENV)/bin/python benchmarks/returns.py --json out/returns.json
	@$(VENV)/bin/python benchmarks/learning.py --json out/learning.json
	@$(VENV)/bin/python benchmarks/collection.py --json out/collection.json
	@$(VENV)/bin/python benchmarks/agreement.py --csv out/agreement.csv --json out/agreement.json
	@$(VENV)/bin/python benchmarks/lerobot_export.py --json out/lerobot_export.json

lint: $(VENV)/.dev  ## ruff, mypy and the contracts of imports
	@$(VENV)/bin/ruff check .
	@$(VENV)/bin/ruff format --check .
	@$(VENV)/bin/mypy
	@$(VENV)/bin/lint-imports --no-logo

format: $(VENV)/.dev  ## ruff's formatter and its safe fixes
	@$(VENV)/bin/ruff check --fix .
	@$(VENV)/bin/ruff format .

clean:  ## remove what make built
	rm -rf $(VENV) .venv-ur-core .venv-ur-emulator $(OLDEST) $(RLLIB) $(LEROBOT) $(CLIENTS) $(KERNEL) out build dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
