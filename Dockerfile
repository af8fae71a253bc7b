# syntax=docker/dockerfile:1
# The Python package, which contains the program `endless`, in a small image:
#
#     docker build --tag endless-gym .
#     docker run --rm --shm-size=2g endless-gym demo --env Endless-MortarMayhem-v0
#     docker run --rm --shm-size=2g endless-gym bench --env all
#
# Batches are in /dev/shm, of which a container has 64 MB by default: --shm-size raises it. Run an engine and its trainers in one
# container, for example with `endless_gym.serve` or `docker exec`; `compose.yaml` runs them in two that share /dev/shm.

ARG PYTHON=3.13
ARG RUST=1.95

FROM rust:${RUST}-slim-bookworm AS build
RUN apt-get update \
    && apt-get install --yes --no-install-recommends python3-venv \
    && rm -rf /var/lib/apt/lists/*
RUN python3 -m venv /opt/maturin && /opt/maturin/bin/pip install --no-cache-dir maturin==1.16.0
WORKDIR /source
COPY . .
RUN /opt/maturin/bin/maturin build --locked --compatibility linux --manifest-path bindings/python/Cargo.toml --out /wheels

FROM python:${PYTHON}-slim-bookworm
RUN --mount=type=bind,from=build,source=/wheels,target=/wheels pip install --no-cache-dir /wheels/*.whl
RUN useradd --create-home endless
USER endless
WORKDIR /home/endless
ENTRYPOINT ["endless"]
CMD ["--help"]
