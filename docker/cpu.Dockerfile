# mops_lightning for machines without a GPU.
#
# Build it from the top of the repository:
#   docker build -f docker/cpu.Dockerfile -t mops-lightning:cpu \
#     --build-arg PIP_EXTRA_INDEX_URL=ADDRESS .
# ADDRESS is that of PyTorch's index of CPU wheels: on PyTorch's page "Get Started" choose Linux,
# Pip and CPU; it stands behind --index-url. pip prefers 2.x.y+cpu from there to 2.x.y. Left out,
# the image works too, but on x86-64 it holds the CUDA build, gigabytes that no CPU uses.
#
# Use it; runs land in ./outputs, and what they share (made data, task nets) in the same cache as
# that of runs outside of containers:
#   mkdir -p outputs ~/.cache/mops_lightning
#   docker run --rm --user "$(id -u):$(id -g)" \
#     -v "$PWD/outputs:/mops/outputs" \
#     -v ~/.cache/mops_lightning:/mops/cache mops-lightning:cpu m=64
# Own data: -v "$PWD/data:/mops/data:ro" and dataset.root=data/NAME.

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
LABEL org.opencontainers.image.title="mops-lightning (CPU)" \
      org.opencontainers.image.description="Task-oriented point cloud downsampling" \
      org.opencontainers.image.licenses="MIT"
# Open to every user like /tmp, for with --user the container runs under the caller's number.
RUN useradd --create-home --uid 1000 mops \
    && install --directory --owner=mops --group=mops --mode=1777 /mops /mops/outputs /mops/cache
# A caller's number has no home, so matplotlib's cache gets a place that all can write to.
ENV MOPS_CACHE=/mops/cache \
    MPLCONFIGDIR=/tmp/matplotlib \
    PYTHONUNBUFFERED=1
ARG PIP_EXTRA_INDEX_URL=""
# Dependencies first: this large layer is made anew only when they change, not with the code.
WORKDIR /opt/mops-lightning
COPY constraints.txt ./
COPY --from=builder /build/dist/requirements.txt ./
RUN pip install --no-cache-dir -c constraints.txt -r requirements.txt
COPY --from=builder /build/dist/*.whl ./
RUN pip install --no-cache-dir -c constraints.txt --no-deps ./*.whl && pip check
USER 1000:1000
WORKDIR /mops
ENTRYPOINT ["python", "-m", "mops_lightning"]
