# The whole user and developer surface. `make help` lists it.
.DEFAULT_GOAL := help
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
MAKEFLAGS += --no-print-directory

CACHE := $(or $(XDG_CACHE_HOME),$(HOME)/.cache)/cloudroid
export CARGO_TARGET_DIR ?= $(CACHE)/cargo
# Python clients (the demo's robot, the stories' roslibpy) live outside the clone, one environment per list of versions.
VENV := $(CACHE)/python-$(shell sha256sum demo/requirements.txt | cut -c1-12)
export CLOUDROID_PYTHON := $(VENV)/bin/python
# The same for programs that read what the daemon answers by HTTP.
READERS := $(CACHE)/readers-$(shell sha256sum tests/readers/requirements.txt | cut -c1-12)
export CLOUDROID_READERS := $(READERS)/bin
# The same with the ROS 2 of a base, for peers of tests.
export CLOUDROID_ROS2_PREFIX := $(shell scripts/ros2-wheels --where)
# The same for the stories' client in JavaScript, and the identity provider.
NODE := $(CACHE)/node-$(shell sha256sum tests/robots/package.json | cut -c1-12)
export CLOUDROID_NODE_MODULES := $(NODE)/node_modules
# The same for what builds the page, and for what looks at it.
WEB := $(CACHE)/web-$(shell sha256sum web/package-lock.json | cut -c1-12)
WEB_TEST := $(CACHE)/web-test-$(shell sha256sum tests/web/package-lock.json | cut -c1-12)
export CLOUDROID_WEB_MODULES := $(WEB_TEST)/node_modules
# cargo-deny and cargo-audit, as programs that were built already: compiling them takes as long as the project.
AUDIT := $(CACHE)/audit-$(shell sha256sum scripts/audit.txt | cut -c1-12)
PREFIX ?= /usr/local

.PHONY: check
check: ## after each change, within minutes: tests and stories of the crates that changed; DRY=1 only says which, BASE=commit since when
	@CLOUDROID_STORIES=1 CLOUDROID_BIN="$(PROGRAMS)" DEV="$(DEV)" SEED="$(SEED)" BASE="$(BASE)" DRY="$(DRY)" scripts/check

.PHONY: help
help: ## what can be asked for
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F':.*## ' '{printf "  make %-12s %s\n", $$1, $$2}'

.PHONY: deps
deps: ## install the Debian packages that building, running and testing need (as root)
	@scripts/deps build run demo test vm

.PHONY: demo-deps
demo-deps:
	@scripts/deps build run demo
	@scripts/python "$(VENV)" demo/requirements.txt

.PHONY: test-deps
test-deps: deps
	@scripts/python "$(VENV)" demo/requirements.txt
	@scripts/python "$(READERS)" tests/readers/requirements.txt
	@scripts/ros2-wheels >/dev/null
	@scripts/node "$(NODE)" tests/robots/package.json
	@scripts/node "$(WEB_TEST)" tests/web/package.json

# PID 1 of every servant and the robot's program are static (scripts/rustc): they run on whatever file system there is. They stand where
# the daemon looks for them, beside it.
.PHONY: init
init:
	@cargo build -q --locked -p init --profile init

.PHONY: stub
stub:
	@cargo build -q --locked -p cloudroid-stub --profile stub
	@install -D -m 755 "$(CARGO_TARGET_DIR)/stub/cloudroid-stub" "$(CARGO_TARGET_DIR)/release/stubs/x86_64/cloudroid-stub"

.PHONY: stub-cross
stub-cross: ## build the robot's program for aarch64 and armv7, too, and try it under qemu (as root)
	@scripts/deps run
	@scripts/stub-cross "$(CACHE)" stub "$(CARGO_TARGET_DIR)/release"

# The same for stories: not optimised, and so within minutes.
.PHONY: stub-cross-dev
stub-cross-dev:
	@scripts/deps run
	@scripts/stub-cross "$(CACHE)" stub-test "$(PROGRAMS)"

.PHONY: test-cross
test-cross: stub-cross-dev build-dev ## robots of those architectures, told as stories under qemu (as root; the first time takes long)
	@scripts/deps build run test cross
	@echo "== stories of other architectures"
	@CLOUDROID_CROSS="$$(cat "$(PROGRAMS)/cross-built")" $(TELL) cross::

# The daemon is compiled with the page that stands in web/dist. Nothing is done where web/ has not changed.
.PHONY: web
web: ## build the page; part of every build
	@scripts/node "$(WEB)" web/package.json
	@scripts/web "$(WEB)" "$(CARGO_TARGET_DIR)/web"

.PHONY: build
build: ## build the daemon, the command line tool and the servants' init, optimised
	@scripts/deps build
	@echo "== building cloudroidd and cloudroidctl (release; the first time takes some minutes)"
	@$(MAKE) init stub web
	@cargo build --locked --release -p cloudroidd -p cloudroidctl
	@install -m 755 "$(CARGO_TARGET_DIR)/init/cloudroid-init" "$(CARGO_TARGET_DIR)/release/cloudroid-init"

# One selection of packages and features for all that is built for tests: Cargo compiles a library once per set of features, and each selection
# has a set of its own. Built with it are the lints, too (scripts/rustc), and the video codec and OpenTelemetry, which no program of a release
# has.
DEV := --locked --workspace --features codec/video,cloudroidd/otel

# Those of its programs that are tested, of this checkout alone.
PROGRAMS := $(CARGO_TARGET_DIR)/checkouts/$(shell pwd -P | sha256sum | cut -c1-12)

# Puts what the daemon looks for beside a daemon that was built by profile $(1).
define beside
	@install -m 755 "$(CARGO_TARGET_DIR)/init/cloudroid-init" "$(CARGO_TARGET_DIR)/$(1)/cloudroid-init"
	@mkdir -p "$(CARGO_TARGET_DIR)/$(1)/stubs/x86_64"
	@strip --strip-debug -o "$(CARGO_TARGET_DIR)/$(1)/stubs/x86_64/cloudroid-stub" "$(CARGO_TARGET_DIR)/$(1)/cloudroid-stub"
endef

.PHONY: beside-dev
beside-dev:
	@scripts/programs "$(PROGRAMS)" true

.PHONY: build-dev
build-dev: init web
	@scripts/programs "$(PROGRAMS)" cargo build $(DEV) --all-targets

.PHONY: build-demo
build-demo: init web
	@scripts/deps build
	@echo "== building cloudroidd and cloudroidctl (not optimised; the first time takes some minutes)"
	@cargo build --locked --profile demo -p cloudroidd -p cloudroidctl -p cloudroid-stub
	$(call beside,demo)

.PHONY: demo-ros
demo-ros:
	@ROS="$(ROS)" demo/demo --validate

.PHONY: demo
demo: demo-ros demo-deps build-demo ## push Debian's people_detect and find people in real pictures; ROS=2 a node of rclpy, CHECK=1 ends by itself
	@ROS="$(ROS)" CHECK="$(CHECK)" BIN="$(CARGO_TARGET_DIR)/demo" demo/demo

.PHONY: types
types: init web ## write the page's types (web/src/lib/types.ts) from the schemas of the API
	@WRITE_TYPES=1 cargo test $(DEV) --lib -- the_pages_types

.PHONY: test
test: ## format, lints, unit tests, stories, a quick evaluation, stories in a virtual machine; says how long each took
	@scripts/parts room test-deps vm-image robots build-dev lint unit vm-home test-vm test-eval stories $(ALSO)

.PHONY: room
room:
	@scripts/room 30 15

.PHONY: lint
lint: init web
	@echo "== format"
	@cargo fmt --all --check
	@echo "== the language of the code"
	@scripts/language
	@echo "== compiler and clippy, warnings denied"
	@scripts/lint $(DEV)
	@echo "== types of the page"
	@cd web && node node_modules/svelte-check/bin/svelte-check --fail-on-warnings --output human
	@echo "== licences and sources of dependencies"
	@scripts/python "$(AUDIT)" scripts/audit.txt
	@"$(AUDIT)/bin/cargo-deny" --locked --log-level error check licenses bans sources

.PHONY: audit
audit: ## look for known vulnerabilities of dependencies; ADVISORIES=DIR names a clone of RustSec's database
	@scripts/python "$(AUDIT)" scripts/audit.txt
	@scripts/audit "$(AUDIT)/bin"

# A change is judged by the same cases every time; `make unit SEED=$RANDOM` looks for new ones.
SEED ?= 1

.PHONY: unit
ifneq ($(ONLY),)
unit:
	@CLOUDROID_BIN="$(PROGRAMS)" DEV="$(DEV)" SEED="$(SEED)" scripts/check unit $(ONLY)
else
unit: build-dev ## the crates' own tests; ONLY="ros link" those of some, SEED=n for other random cases than the usual
	@echo "== unit tests"
	@CLOUDROID_BIN="$(PROGRAMS)" PROPTEST_RNG_SEED=$(SEED) cargo test $(DEV) --tests --no-fail-fast
	@echo "== the codec without video"
	@PROPTEST_RNG_SEED=$(SEED) cargo test --locked -p codec --test properties -- a_build_without_video

endif

# The stories are a test target of Cargo's that says so and ends where it is run with all others.
TELL := CLOUDROID_STORIES=1 CLOUDROID_BIN="$(PROGRAMS)" cargo test $(DEV) --test stories --

.PHONY: robots
robots:
	@scripts/robots "$(CACHE)" "$(PROGRAMS)"

.PHONY: stories
stories: build-dev robots ## the whole system, told as stories; ONLY=name runs those whose name contains it
	@echo "== stories"
	@$(TELL) $(ONLY)

.PHONY: test-web
test-web: build-dev ## the page in a real browser, against a real daemon; screenshots are below target/web
	@scripts/node "$(WEB_TEST)" tests/web/package.json
	@echo "== the page in Chromium"
	@$(TELL) page::

.PHONY: test-vm
test-vm: build-dev ## what needs systemd, cgroup v2 and power cuts, in a virtual machine; ONLY=name for some
	@scripts/deps build run vm
	@echo "== stories in a virtual machine"
	@VM_STORIES="$$(cargo test $(DEV) -q --test vm --no-run --message-format=json | sed -n 's/.*"executable":"\([^"]*\/vm-[^"]*\)".*/\1/p')" \
	  tests/vm/run "$(PROGRAMS)" $(ONLY)

# What the virtual machine is made of takes minutes once, and depends on little: it is made beside what comes before it.
.PHONY: vm-image
vm-image:
	@scripts/deps vm
	@tests/vm/run --image

.PHONY: vm-home
vm-home: build-dev
	@scripts/deps build run vm
	@tests/vm/run --home "$(PROGRAMS)"

.PHONY: bench
bench: test-deps build ## every measurement with its peer in the same run; ONLY=name for one
	@BIN="$(CARGO_TARGET_DIR)/release" scripts/bench $(ONLY)

# What the evaluation runs beside its own experiments.
EVAL_BENCHES := servant portal link
# Its programs stand by themselves: they have the codec of colour video, which is a feature.
EVAL := $(CARGO_TARGET_DIR)/eval-programs

.PHONY: eval
ifneq ($(QUICK),)
eval: eval-quick
else
eval: test-deps build ## the published experiments on this machine, with a report; QUICK=1: few requests; ONLY=2,7; FRESH=1: all anew (as root)
	@scripts/deps build run test eval engines
	@cargo build --locked --release -p eval $(EVAL_BENCHES:%=-p bench-%)
	@cargo build --locked --release -p cloudroidd --features video
	@cargo build --locked --profile stub -p cloudroid-stub --features video
	@install -D -m 755 "$(CARGO_TARGET_DIR)/stub/cloudroid-stub" "$(EVAL)/stubs/x86_64/cloudroid-stub"
	@for program in eval cloudroidd cloudroidctl cloudroid-init $(EVAL_BENCHES:%=bench-%); do \
	  install -m 755 "$(CARGO_TARGET_DIR)/release/$$program" "$(EVAL)/$$program"; \
	done
	@$(MAKE) build
	@CLOUDROID_BIN="$(EVAL)" "$(EVAL)/eval" $(EVAL_WORDS)
endif

EVAL_WORDS = $(if $(FRESH),--fresh) $(if $(ONLY),--only $(ONLY))

# A part of make test, with the programs that its other parts use: it shows that everything works, and its figures are of programs that
# are not optimised.
.PHONY: eval-quick
eval-quick: test-deps build-dev
	@scripts/deps build run test eval
	@echo "== quick evaluation"
	@CLOUDROID_BIN="$(PROGRAMS)" "$(PROGRAMS)/eval" --quick $(EVAL_WORDS)

# What was measured before a change says nothing of it. What could not be measured is tried once more.
.PHONY: test-eval
test-eval:
	@$(MAKE) eval-quick FRESH=1 || $(MAKE) eval-quick

.PHONY: fuzz
fuzz: ## a minute of fuzzing for every decoder; ONLY=name for one, FUZZ_SECONDS=n for another time
	@scripts/deps build fuzz
	@scripts/fuzz "$(CACHE)" $(ONLY)

.PHONY: deb
deb: build ## make a Debian package below target/debian
	@scripts/deb "$(CARGO_TARGET_DIR)/release" target/debian

.PHONY: install
install: build ## install binaries, units and the example configuration below PREFIX
	@scripts/install "$(CARGO_TARGET_DIR)/release" "$(DESTDIR)" "$(PREFIX)"

.PHONY: uninstall
uninstall: ## end every servant and remove what `make install` put below PREFIX; state and configuration stay
	@scripts/uninstall "$(PREFIX)"
