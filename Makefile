# Three commands for people: `make demo`, `make quick`, which is what a change needs while it is made, and `make test`,
# which it needs in the end. Each sets up what it needs in .venv, once.
#
#   make PYTHON=python3.12 test      another interpreter (3.11 or later)
#   make PIP_FLAGS="--extra-index-url https://download.pytorch.org/whl/cpu" test
#                                    PyTorch's small CPU build, where pip's own index has the CUDA build only
#   make EXTRAS=dev,ray test         with Ray too, before there is a .venv: tests of --ray and of a fleet skip without it
#   make EXTRAS=dev,examples test    with Meta-World and Fetch, likewise: 300 MB more

PYTHON ?= python3.11
PIP_FLAGS ?=
BUILD_FLAGS ?=
EXTRAS ?= dev
LEROBOT_PYTHON ?= python3.12
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/installed.stamp

.DELETE_ON_ERROR:
# pip does not compile what it installs (--no-compile): Python compiles what is imported, and keeps it unless this is set.
unexport PYTHONDONTWRITEBYTECODE
.PHONY: demo quick test lint types pytest together alone test-avx2 test-arm test-matrix benchmark docs release containers test-lerobot test-openpi clean

demo: $(READY)
	$(BIN)/python examples/pusht/demo.py

# On two cores two minutes. Every room has tests here; what takes longer is marked slow.
quick: lint
	$(BIN)/pytest $(TOGETHER) -m "not slow and not alone and not soak"

# Mypy has one thread, so it runs beside the tests; what takes times waits until both are done.
test: lint
	$(MAKE) --jobs=2 types together
	$(MAKE) alone
	$(BIN)/python tests/covered.py

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# mypy must see the package as it is installed, with passes/ and runtimes/ inside it, and the examples as they see each
# other, from the folders in mypy_path (pyproject.toml): it gets a copy laid out like that.
TYPED := build/types
types: $(READY)
	rm -rf $(TYPED)
	mkdir -p $(TYPED)/recipes
	cp -Rp ttscompile tests examples plugins/lerobot_policy_ttscompile $(TYPED)
	cp -Rp passes runtimes plugins/doctor plugins/hub plugins/policies plugins/rivals plugins/serving $(TYPED)/ttscompile
	mv $(TYPED)/examples/policies/*.py $(TYPED)/recipes
	cd $(TYPED) && ../../$(BIN)/mypy --config-file ../../pyproject.toml --cache-dir ../../.mypy_cache .

# On all cores, each with a file at a time; then, one by one, what takes times. The first case of each test of make
# quick is measured on the way: what share of the core's lines they run. Pytest's plugin for logs would go through
# all loggers six times a test.
TOGETHER := -n logical --dist loadfile --benchmark-disable -p no:logging
pytest: together
	$(MAKE) alone
	$(BIN)/python tests/covered.py

together: $(READY)
	$(BIN)/pytest $(TOGETHER) -m "not alone and not soak" --cov --cov-report=

# Of the files that have such tests, so that the others are not imported once more.
alone: $(READY)
	$(BIN)/pytest -m "alone and not soak" $$(grep --recursive --files-with-matches --include='test_*.py' 'mark\.alone' tests)

# The same as on a processor without AVX-512: torch, MKL, oneDNN, OpenBLAS and numpy each have a switch of their own.
# onnxruntime has none; its matrix products of fp32 give the same bits with either (Conv and Softmax do not).
test-avx2: export ATEN_CPU_CAPABILITY := avx2
test-avx2: export MKL_ENABLE_INSTRUCTIONS := AVX2
test-avx2: export ONEDNN_MAX_CPU_ISA := AVX2
test-avx2: export OPENBLAS_CORETYPE := Haswell
test-avx2: export NPY_DISABLE_CPU_FEATURES := X86_V4 AVX512_ICL AVX512_SPR
# torch.compile keeps what it compiled, and takes it again under other switches, where it computes something else.
test-avx2: export TORCHINDUCTOR_CACHE_DIR := $(CURDIR)/build/inductor-avx2
test-avx2: $(READY)
	$(BIN)/pytest $(TOGETHER) -m "not alone and not soak"

# The runtime on emulated ARM processors; see docs/machines.md. The first time takes half an hour.
test-arm: $(READY)
	$(BIN)/python tests/machines/arm.py

# Compiled policies in LeRobot itself, with lerobot's own pins (torch below 2.12), in an environment of its own. Not a part
# of make test: it installs lerobot. Where pip's own index has PyTorch's CUDA build only, see PIP_FLAGS above.
#
#   make LEROBOT_PYTHON=python3.13 test-lerobot
LEROBOT := build/lerobot
test-lerobot:
	test -x $(LEROBOT)/bin/python || $(LEROBOT_PYTHON) -m venv $(LEROBOT)
	$(LEROBOT)/bin/python -m pip install --quiet --disable-pip-version-check $(PIP_FLAGS) \
		'lerobot[async,diffusion,multi-task-dit,pusht]==0.6.1' gymnasium-robotics -e '.[compile,videos]' -e plugins/lerobot_policy_ttscompile \
		hypothesis pytest pytest-benchmark
	$(LEROBOT)/bin/python -m pytest tests/plugins tests/capture/test_export.py tests/policies/test_lerobot.py tests/trajectories

# The published client of openpi, which has numpy below 2 and so an environment of its own, against ttscompile serve --openpi.
OPENPI := build/openpi-venv
test-openpi: $(READY)
	test -x $(OPENPI)/bin/python || $(PYTHON) -m venv $(OPENPI)
	$(OPENPI)/bin/python -m pip install --quiet --disable-pip-version-check openpi-client==0.1.2 \
		typing_extensions  # which it imports and does not ask for
	$(BIN)/pytest tests/serving/test_openpi_client.py

# Python 3.10 to 3.13, one core, AVX2 alone, as far as they are here; see docs/machines.md.
test-matrix: $(READY)
	$(BIN)/python tests/machines/matrix.py

benchmark: $(READY)
	$(BIN)/pytest --benchmark-only

# The site, into build/site.
docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# An sdist and a wheel in build/release, checked as the index does, and tried in empty environments. Nothing is uploaded.
# With TAG=v1.2.3 it ends at once unless this is the tag of VERSION.
TAG :=
release: $(READY)
	$(BIN)/python tests/release.py build/release $(TAG)

# Both images of containers/, with docker or buildah, and what they are for done in them.
containers: $(READY)
	$(BIN)/python tests/containers.py $(BUILD_FLAGS)

clean:
	rm -rf $(VENV) build ttscompile.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis

$(READY): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile $(PIP_FLAGS) -c constraints.txt -e '.[$(EXTRAS)]'
	touch $@
