# Every way to run the project from a checkout. Each target does its own set-up, inside the checkout only:
#
#   .venv           the project, editable, with what its development needs
#   .venv-3.12, …   the same for the unit tests on other Pythons
#   .peers          foreign Modbus programs that the interop tests talk to; never a dependency of the project
#
# Stamp files inside the environments depend on pyproject.toml, so the second run sets nothing up.
# PYTHON=/path/to/python chooses the interpreter (3.11 or newer).

SHELL := /bin/sh
.NOTPARALLEL:
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help

VENV  := .venv
PEERS := .peers
BENCH_PEERS := bench/build/peers
RUN   := $(VENV)/bin
# What is imported is compiled then: most modules of what is installed never are.
PIP   := -m pip --disable-pip-version-check --quiet install --no-compile

# The Pythons that the unit tests also run on where they are present.
OTHER_PYTHONS := 3.12 3.13
# Of those between the oldest and the newest: the library alone. Applications and commands run on these two.
LIBRARY_PYTHONS := 3.12
APPLICATIONS := tests/apps tests/cli

# Exact versions: the interop tests compare values, and these programs change from release to release.
PEER_PACKAGES := pymodbus==3.16.1 pyModbusTCP==0.3.1 minimalmodbus==2.1.1 pysparkplug==0.6.1 pysunspec2==1.3.7

# Published programs that run over `busway.compat`, what they import, and the releases of pymodbus they were written for
# where that is not the one above. In folders of their own: none of them meets the others' versions.
PROGRAM_PACKAGES := modpoll==1.6.0 sdm_modbus==0.7.0 solaredge_modbus==0.8.0 alfen_eve_modbus_tcp==0.0.17 \
	prettytable==3.18.0 wcwidth==0.9.4 paho-mqtt==2.2.0 requests==2.34.2 urllib3==2.8.0 certifi==2026.10.18 \
	idna==3.20 charset-normalizer==3.5.2 epevermodbus==0.0.18 retrying==1.4.2 pyserial==3.5
PYMODBUS_RELEASES := 3.6.9 3.9.2
PEERS_WANTED = $(PEER_PACKAGES) $(PROGRAM_PACKAGES) $(PYMODBUS_RELEASES)

# Every second unit test waits for something, so there is room for one more than there are processors.
JOBS ?= $(shell expr $$(getconf _NPROCESSORS_ONLN) + 1)
SIDE_BY_SIDE := --numprocesses=$(JOBS) --maxprocesses=4 --dist=worksteal
# Folders without unit tests: collecting them takes time in every process.
OTHER_TESTS := tests/browser tests/interop tests/load tests/network tests/packaging tests/soak
UNIT_TESTS := -m "not (real_time or interop or packaging or soak)" $(SIDE_BY_SIDE) $(OTHER_TESTS:%=--ignore=%)

# Tests in real time wait most of the time, so four files run at once, each in one process. The files that take longest begin
# first: else the last one runs alone for minutes. Tests against foreign programs run three at once.
THREE_AT_ONCE := --numprocesses=3 --dist=loadfile
FOUR_AT_ONCE := --numprocesses=4 --dist=loadfile --no-loadscope-reorder
LONGEST_FILES := $(addprefix tests/, \
	$(addprefix apps/fleet/test_, chaos.py fleet_collector.py queueing_gateway.py streams.py fleet_commands.py) \
	browser/test_fleet_demo_page.py client/test_interrupted_calls.py apps/collector/test_exactly_once.py \
	$(addprefix cli/test_, fleet_stream.py fleet_demo.py fleet_restore.py))
REAL_TIME_FILES = $(LONGEST_FILES) tests/browser tests/network $$(grep -rl --include='test_*.py' 'mark\.real_time' tests)
ALONE_FILES = tests/load $$(grep -rl --include='test_*.py' 'mark\.alone' tests)

# Runs on one Python: documentation and tools; models without IO; walks by chance; kills; servers of others; commands as
# processes, but for those that read, write, serve and collect.
ONE_PYTHON := $(addprefix tests/, \
	bench docs fuzz speed_guard typing testing/test_plugin.py \
	$(addprefix test_, coroutine_tests.py extras.py imports.py makefile.py no_circles.py pytest_settings.py room_maps.py \
	words.py) \
	access/test_policy_fuzz.py apps/gateway/test_no_way_round.py server/test_no_way_round.py \
	$(addprefix session/test_, client_stateful.py multidrop.py serial_late_replies_model.py unit_breaker.py) \
	$(addprefix apps/collector/test_, clock_trust_walk.py clock_walk.py dashboards.py held_walk.py learning.py \
	many_dead_devices.py plan.py reload_walk.py right_values.py schedule.py) \
	apps/collector/alarms/test_alarm_walk.py apps/collector/alarms/test_collector_alarms.py \
	$(addprefix apps/collector/commands/test_, crashes.py no_way_round_rules.py no_write_twice.py) \
	$(addprefix apps/collector/sinks/test_, delivery_walk.py hour_outage.py kills.py real_servers.py sparkplug_walk.py) \
	$(addprefix apps/collector/store/test_, backup_walk.py crashes.py power_failure.py store_reader.py same_answers.py \
	sealed_reader.py store_walk.py) \
	apps/control/test_service.py \
	$(addprefix apps/fleet/test_, chain_model.py coordinators.py gap_coverage.py lease_holder.py outbox_walk.py) \
	$(addprefix cli/test_, demo.py fleet.py gateway.py serve_access.py simulate.py simulate_api.py simulate_faults.py \
	simulate_sources.py status.py))
PYTEST_FLAGS ?=

# Tests start hundreds of programs: where the environment forbids bytecode, half of their time goes into compiling.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help
help: ## this list
	@grep -E '^[a-z-]+:.*## ' $(firstword $(MAKEFILE_LIST)) | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 16

# --- what users run ---------------------------------------------------------------------------------------------------

.PHONY: demo
demo: $(VENV)/.installed-demo ## a small plant, a gateway, a collector and its page on 127.0.0.1 for a minute
	@$(RUN)/busway collect demo $(DEMO_FLAGS)

.PHONY: fleet-demo
fleet-demo: $(VENV)/.installed-fleet-demo ## three collectors that share a plant, one of them is killed; needs nats-server
	@$(RUN)/busway fleet demo $(DEMO_FLAGS)

# --- what developers run ----------------------------------------------------------------------------------------------

.PHONY: test
test: check test-unit test-real-time test-interop test-packaging test-versions ## everything that tests the project

.PHONY: check
check: $(VENV)/.installed-dev ## format, lint, types, the way imports point, and what tests import
	@echo "== format, lint, types, imports"
	@$(RUN)/ruff format --check --quiet . || { echo "error: run '$(RUN)/ruff format .'" >&2; exit 1; }
	@$(RUN)/ruff check --quiet .
	@$(RUN)/python -m pytest --collect-only -qq >/dev/null & \
	$(RUN)/mypy --no-error-summary || exit 1; wait # pytest prepares its asserts: else each process of the unit tests does
	@$(RUN)/lint-imports --no-cache >/dev/null || { $(RUN)/lint-imports --no-cache; exit 1; }
	@$(RUN)/python -m pytest --quiet --no-summary tests/test_imports.py >/dev/null || \
		{ $(RUN)/python -m pytest --quiet tests/test_imports.py; exit 1; }

.PHONY: docs
docs: $(VENV)/.installed-dev ## the documentation as a site, in build/site; needs no network
	@$(RUN)/python scripts/site.py

.PHONY: screenshots
screenshots: $(VENV)/.installed-dev ## the pictures of README and start page, in docs/figures; needs chromium
	@$(RUN)/python scripts/screenshots.py

.PHONY: test-unit
test-unit: $(VENV)/.installed-dev ## unit tests, side by side
	@echo "== unit tests"
	@$(RUN)/python -m pytest $(UNIT_TESTS) $(PYTEST_FLAGS)

.PHONY: test-real-time
test-real-time: $(VENV)/.installed-dev ## unit tests about time, load and the system, four at once, some alone
	@echo "== tests in real time"
	@$(RUN)/python -m pytest -m "real_time and not (alone or interop or soak)" $(FOUR_AT_ONCE) $(PYTEST_FLAGS) \
		$(REAL_TIME_FILES)
	@echo "== tests in real time that measure delays"
	@$(RUN)/python -m pytest -m "alone and not (interop or soak)" $(PYTEST_FLAGS) $(ALONE_FILES)

.PHONY: test-interop
test-interop: $(VENV)/.installed-dev peers ## tests against programs that are not ours
	@echo "== interop tests"
	@$(RUN)/python -m pytest -m "interop and not soak" $(THREE_AT_ONCE) tests/interop $(PYTEST_FLAGS)

.PHONY: test-packaging
test-packaging: $(VENV)/.installed-dev ## wheel and sdist, built, installed and used
	@echo "== packaging test"
	@$(RUN)/python -m pytest -m packaging tests/packaging $(PYTEST_FLAGS)

.PHONY: test-versions
test-versions: $(OTHER_PYTHONS:%=test-python-%) ## unit tests on the other Pythons that are present

.PHONY: $(OTHER_PYTHONS:%=test-python-%)
$(OTHER_PYTHONS:%=test-python-%): test-python-%:
	@if $(RUN)/python -c "import sys; sys.exit('%d.%d' % sys.version_info[:2] != '$*')" 2>/dev/null; then \
		echo "== Python $*: it ran everything above"; \
	elif interpreter=$$(scripts/find-python $*); then \
		echo "== unit tests on Python $*"; \
		$(MAKE) --no-print-directory PYTHON="$$interpreter" VENV=$(VENV)-$* \
			$(if $(filter $*,$(LIBRARY_PYTHONS)),LEFT_OUT="$(APPLICATIONS)") test-unit-quietly; \
	else \
		echo "== Python $* is not here: its unit tests are left out"; \
	fi

# What is about the system and not about Python has been tried once already, and so have most examples of properties.
.PHONY: test-unit-quietly
test-unit-quietly: $(VENV)/.installed-dev
	@BUSWAY_FEW_EXAMPLES=1 $(RUN)/python -m pytest --quiet $(UNIT_TESTS) $(patsubst %,--ignore=%,$(ONE_PYTHON) $(LEFT_OUT)) $(PYTEST_FLAGS)

.PHONY: explore
explore: $(VENV)/.installed-dev ## unit tests with examples of properties drawn anew
	@BUSWAY_NEW_EXAMPLES=1 $(RUN)/python -m pytest $(UNIT_TESTS) $(PYTEST_FLAGS)

.PHONY: soak
soak: $(VENV)/.installed-dev ## tests that take minutes
	@$(RUN)/python -m pytest -m soak -o faulthandler_timeout=0 $(PYTEST_FLAGS)

.PHONY: bench
bench: $(VENV)/.installed-dev bench-peers ## one table of speed, ours and the peers in the same run
	@$(RUN)/python -m bench $(BENCH_FLAGS)

.PHONY: bench-quick
bench-quick: $(VENV)/.installed-dev bench-peers ## the same in under a minute
	@$(RUN)/python -m bench --quick $(BENCH_FLAGS)

.PHONY: peers
peers: $(PEERS)/.installed ## the foreign programs of the interop tests

.PHONY: check-peers
check-peers: $(VENV)/.installed-dev peers $(PEERS)/.check-installed ## busway check of other libraries' servers, and its page
	@cc -O1 -o $(PEERS)/libmodbus_server tests/interop/peers/libmodbus_server.c $$(pkg-config --cflags --libs libmodbus)
	@$(RUN)/python scripts/check_peers.py \
		"busway=$$($(RUN)/python -c 'import busway; print(busway.__version__)')=$(RUN)/python tests/interop/peers/busway_server.py 0" \
		"libmodbus=$$(pkg-config --modversion libmodbus)=$(PEERS)/libmodbus_server tcp 0" \
		"pymodbus=3.16.1=$(PEERS)/bin/python tests/interop/peers/pymodbus_server.py tcp 0" \
		"pyModbusTCP=0.3.1=$(PEERS)/bin/python tests/interop/peers/pymodbustcp_server.py 0" \
		"tmodbus=1.1.0=$(PEERS)/check/bin/python tests/interop/peers/tmodbus_server.py 0" \
		"uModbus=1.0.4=$(PEERS)/check/bin/python tests/interop/peers/umodbus_server.py 0"

# tmodbus needs Python 3.12, where the other peers run on the Python of the project.
$(PEERS)/.check-installed: Makefile | $(PEERS)/.installed
	@interpreter=$$(scripts/find-python 3.12) || { echo "error: tmodbus needs Python 3.12" >&2; exit 1; }; \
	"$$interpreter" -m venv $(PEERS)/check && $(PEERS)/check/bin/python $(PIP) tmodbus==1.1.0 umodbus==1.0.4
	@touch $@

.PHONY: bench-peers
bench-peers: $(BENCH_PEERS)/.installed ## the foreign programs of the benchmark

.PHONY: release
release: $(VENV)-release/.installed ## sdist, wheel, SBOM and checksums of the last commit in dist, each extra tried
	@$(VENV)-release/bin/python scripts/release.py $(RELEASE_FLAGS)

.PHONY: publish
publish: $(VENV)-release/.installed ## uploads what `make release` has made, when a person types the version
	@$(VENV)-release/bin/python scripts/release.py --publish

.PHONY: clean
clean: ## removes everything that these targets made
	rm -rf $(VENV) $(VENV)-3.* $(VENV)-release $(PEERS) dist build bench/build bench/results tests/interop/build
	rm -rf .cache .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find src tests bench scripts -name __pycache__ -type d -prune -exec rm -rf {} +

# --- set-up -----------------------------------------------------------------------------------------------------------

$(VENV)/bin/python:
	@interpreter=$${PYTHON:-$$(scripts/find-python)} || exit 1; \
	"$$interpreter" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
		{ echo "error: $$interpreter is not a Python 3.11 or newer" >&2; exit 1; }; \
	"$$interpreter" -c 'import venv, ensurepip' 2>/dev/null || \
		{ echo "error: $$interpreter lacks the modules venv and ensurepip (Debian: apt-get install python3-venv)" >&2; \
		exit 1; }; \
	echo "== $(VENV): a virtual environment of $$interpreter"; \
	"$$interpreter" -m venv $(VENV)

$(VENV)/.installed-demo: pyproject.toml | $(VENV)/bin/python
	@echo "== $(VENV): the project with its commands, its store and its pages"
	@$(RUN)/python $(PIP) --editable '.[serial,cli,files,store,web]'
	@touch $@

$(VENV)/.installed-fleet-demo: pyproject.toml | $(VENV)/bin/python
	@echo "== $(VENV): the project with its commands, its store, its pages and its fleet"
	@$(RUN)/python $(PIP) --editable '.[serial,cli,files,store,web,fleet]'
	@touch $@

$(VENV)/.installed-dev: pyproject.toml | $(VENV)/bin/python
	@echo "== $(VENV): the project and what its development needs"
	@$(RUN)/python $(PIP) --editable '.[dev]'
	@touch $@ $(VENV)/.installed-demo $(VENV)/.installed-fleet-demo

$(VENV)-release/.installed: pyproject.toml | $(VENV)/bin/python
	@echo "== $(VENV)-release: what makes a release"
	@$(RUN)/python -m venv $(VENV)-release && $(VENV)-release/bin/python $(PIP) '.[release]'
	@touch $@

# The stamp names the packages, so a changed pin reinstalls.
$(PEERS)/.installed: Makefile | $(VENV)/bin/python
	@if [ "$$(cat $@ 2>/dev/null)" != "$(PEERS_WANTED)" ]; then \
		echo "== $(PEERS): $(PEERS_WANTED)"; \
		$(RUN)/python -m venv $(PEERS) && $(PEERS)/bin/python $(PIP) $(PEER_PACKAGES) && \
		rm -rf $(PEERS)/programs $(PEERS)/pymodbus && \
		$(PEERS)/bin/python $(PIP) --no-deps --target $(PEERS)/programs $(PROGRAM_PACKAGES) || exit 1; \
		for release in $(PYMODBUS_RELEASES); do \
			$(PEERS)/bin/python $(PIP) --no-deps --target $(PEERS)/pymodbus/$$release pymodbus==$$release || exit 1; \
		done; \
	fi
	@echo "$(PEERS_WANTED)" > $@

$(BENCH_PEERS)/.installed: bench/peers/requirements.txt | $(VENV)/bin/python
	@echo "== $(BENCH_PEERS): the peers of the benchmark"
	@$(RUN)/python -m venv $(BENCH_PEERS) && $(BENCH_PEERS)/bin/python $(PIP) --requirement $<
	@touch $@
