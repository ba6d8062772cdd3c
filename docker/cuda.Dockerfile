# mops_lightning for NVIDIA GPUs.
#
# Build it from the top of the repository:
#   docker build -f docker/cuda.Dockerfile -t mops-lightning:cuda .
# torch then comes with the CUDA version that PyTorch publishes by default. For another one (an
# older driver) add --build-arg PIP_EXTRA_INDEX_URL=ADDRESS, the address behind --index-url on
# PyTorch's page "Get Started" for that CUDA version.
#
# Use it, with the NVIDIA Container Toolkit on the host; runs land in ./outputs, and what they
# share (made data, task nets) in the same cache as that of runs outside of containers:
#   mkdir -p outputs ~/.cache/mops_lightning
#   docker run --rm --gpus all --user "$(id -u):$(id -g)" \
#     -v "$PWD/outputs:/mops/outputs" \
#     -v ~/.cache/mops_lightning:/mops/cache mops-lightning:cuda m=64
# Own data: -v "$PWD/data:/mops/data:ro" and dataset.root=data/NAME.
#
# The base is plain Python, not nvidia/cuda: torch's CUDA wheel requires its own CUDA libraries, in
# versions that it names itself (so constraints.txt lists none), and the driver comes from the
# host. An nvidia/cuda image would add gigabytes of the same libraries that nothing loads.

FROM python:3.12.12-slim-trixie AS builder
WORKDIR /build
COPY constraints.txt ./
RUN pip install --no-cache-dir -c constraints.txt build hatchling
COPY pyproject.toml README.md LICENSE ./
COPY src src
COPY conf conf
# The requirements alone as well, so that the last stage can install them before the package.
RUN python -m build --wheel --no-isolation --outdir dist \
    && python -c "import tomllib; print(*tomllib.load(open('pyproject.toml', 'rb'))['project']['dependencies'], sep='\n')" > dist/requirements.txt

FROM python:3.12.12-slim-trixie
LABEL org.opencontainers.image.title="mops-lightning (CUDA)" \
      org.opencontainers.image.description="Task-oriented point cloud downsampling" \
      org.opencontainers.image.licenses="MIT"
# Open to every user like /tmp, for with --user the container runs under the caller's number.
RUN useradd --create-home --uid 1000 mops \
    && install --directory --owner=mops --group=mops --mode=1777 /mops /mops/outputs /mops/cache
# A caller's number has no home, so matplotlib's cache gets a place that all can write to. The
# NVIDIA lines are what nvidia/cuda images say: show the GPUs, with CUDA and nvidia-smi.
ENV MOPS_CACHE=/mops/cache \
    MPLCONFIGDIR=/tmp/matplotlib \
    NVIDIA_DRIVER_CAPABILITIES=compute,utility \
    NVIDIA_VISIBLE_DEVICES=all \
    PYTHONUNBUFFERED=1
ARG PIP_EXTRA_INDEX_URL=""
# Dependencies first: this large layer is made anew only when they change, not with the code.
WORKDIR /opt/mops-lightning
COPY constraints.txt ./
COPY --from=builder /build/dist/requirements.txt ./
# A torch without CUDA (from a mirror, say) ends the build here, not a user's run later.
RUN pip install --no-cache-dir -c constraints.txt -r requirements.txt \
    && python -c "import torch; assert torch.version.cuda, f'torch {torch.__version__} has no CUDA'"
COPY --from=builder /build/dist/*.whl ./
RUN pip install --no-cache-dir -c constraints.txt --no-deps ./*.whl && pip check
USER 1000:1000
WORKDIR /mops
ENTRYPOINT ["python", "-m", "mops_lightning"]
