# mops_lightning for machines without a GPU.
#
# Build it from the root of the repository:
#   docker build -f docker/cpu.Dockerfile -t mops-lightning:cpu \
#     --build-arg PIP_EXTRA_INDEX_URL=ADDRESS .
# ADDRESS is PyTorch's index of CPU wheels: on PyTorch's page "Get Started" choose Linux, Pip and
# CPU, and copy the address after --index-url. pip prefers its 2.x.y+cpu to 2.x.y. Without it the
# image works too, but on x86-64 it contains the CUDA build, which adds gigabytes.
#
# Run it; results are written to ./outputs. Generated data and task nets are shared with runs
# outside of containers through the same cache:
#   mkdir -p outputs ~/.cache/mops_lightning
#   docker run --rm --user "$(id -u):$(id -g)" \
#     -v "$PWD/outputs:/mops/outputs" \
#     -v ~/.cache/mops_lightning:/mops/cache mops-lightning:cpu m=64
# Your own data: -v "$PWD/data:/mops/data:ro" and dataset.root=data/NAME.

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
LABEL org.opencontainers.image.title="mops-lightning (CPU)" \
      org.opencontainers.image.description="Task-oriented point cloud downsampling" \
      org.opencontainers.image.licenses="MIT"
# Writable by every user, like /tmp: with --user the container runs with the caller's user ID.
RUN useradd --create-home --uid 1000 mops \
    && install --directory --owner=mops --group=mops --mode=1777 /mops /mops/outputs /mops/cache
# That user has no home directory, so matplotlib's cache is in /tmp.
ENV MOPS_CACHE=/mops/cache \
    MPLCONFIGDIR=/tmp/matplotlib \
    PYTHONUNBUFFERED=1
ARG PIP_EXTRA_INDEX_URL=""
# Dependencies first: this large layer is rebuilt only when they change, not with the code.
WORKDIR /opt/mops-lightning
COPY constraints.txt ./
COPY --from=builder /build/dist/requirements.txt ./
RUN pip install --no-cache-dir -c constraints.txt -r requirements.txt
COPY --from=builder /build/dist/*.whl ./
RUN pip install --no-cache-dir -c constraints.txt --no-deps ./*.whl && pip check
USER 1000:1000
WORKDIR /mops
ENTRYPOINT ["python", "-m", "mops_lightning"]
