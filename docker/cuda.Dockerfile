# mops_lightning for NVIDIA GPUs.
#
# Build it from the root of the repository:
#   docker build -f docker/cuda.Dockerfile -t mops-lightning:cuda .
# This installs torch with PyTorch's default CUDA version. For another one (an older driver) add
# --build-arg PIP_EXTRA_INDEX_URL=ADDRESS, the address after --index-url on PyTorch's page "Get
# Started" for that CUDA version.
#
# Run it, with the NVIDIA Container Toolkit on the host; results are written to ./outputs. Generated
# data and task nets are shared with runs outside of containers through the same cache:
#   mkdir -p outputs ~/.cache/mops_lightning
#   docker run --rm --gpus all --user "$(id -u):$(id -g)" \
#     -v "$PWD/outputs:/mops/outputs" \
#     -v ~/.cache/mops_lightning:/mops/cache mops-lightning:cuda m=64
# Your own data: -v "$PWD/data:/mops/data:ro" and dataset.root=data/NAME.
#
# The base is plain Python, not nvidia/cuda: torch's CUDA wheel requires CUDA libraries in versions
# of its own (so constraints.txt has none), and the host provides the driver. An nvidia/cuda image
# would add gigabytes of libraries that are never loaded.

FROM python:3.12.12-slim-trixie AS builder
WORKDIR /build
COPY constraints.txt ./
RUN pip install --no-cache-dir -c constraints.txt build hatchling
COPY pyproject.toml README.md LICENSE ./
COPY src src
COPY conf conf
COPY sweeps sweeps
# The requirements, with those of LAS files, are written to a file too, so that the last stage can
# install them first.
RUN python -m build --wheel --no-isolation --outdir dist \
    && python -c "import tomllib; p = tomllib.load(open('pyproject.toml', 'rb'))['project']; print(*p['dependencies'], *p['optional-dependencies']['las'], sep='\n')" > dist/requirements.txt

FROM python:3.12.12-slim-trixie
LABEL org.opencontainers.image.title="mops-lightning (CUDA)" \
      org.opencontainers.image.description="Task-oriented point cloud downsampling" \
      org.opencontainers.image.licenses="MIT"
# Writable by every user, like /tmp: with --user the container runs with the caller's user ID.
RUN useradd --create-home --uid 1000 mops \
    && install --directory --owner=mops --group=mops --mode=1777 /mops /mops/outputs /mops/cache
# That user has no home directory, so matplotlib's cache is in /tmp. The NVIDIA variables are those
# of nvidia/cuda images: all GPUs, with CUDA and nvidia-smi.
ENV MOPS_CACHE=/mops/cache \
    MPLCONFIGDIR=/tmp/matplotlib \
    NVIDIA_DRIVER_CAPABILITIES=compute,utility \
    NVIDIA_VISIBLE_DEVICES=all \
    PYTHONUNBUFFERED=1
ARG PIP_EXTRA_INDEX_URL=""
# Dependencies first: this large layer is rebuilt only when they change, not with the code.
WORKDIR /opt/mops-lightning
COPY constraints.txt ./
COPY --from=builder /build/dist/requirements.txt ./
# If pip found a torch without CUDA, the build fails here and not in a user's run.
RUN pip install --no-cache-dir -c constraints.txt -r requirements.txt \
    && python -c "import torch; assert torch.version.cuda, f'torch {torch.__version__} has no CUDA'"
COPY --from=builder /build/dist/*.whl ./
RUN pip install --no-cache-dir -c constraints.txt --no-deps ./*.whl && pip check
USER 1000:1000
WORKDIR /mops
ENTRYPOINT ["python", "-m", "mops_lightning"]
