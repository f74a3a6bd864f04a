# docker build -f docker/server.Dockerfile -t potserver:0.1.0 .
# Name the base image by its digest where builds must repeat: --build-arg BASE=python:3.11-slim-bookworm@sha256:...
# A base without one is told; with --build-arg PINNED=1 it is refused.
ARG BASE=python:3.11-slim-bookworm
FROM ${BASE} AS build
ARG BASE
ARG PINNED=
RUN case "${BASE}" in *@sha256:*) ;; *) echo "${BASE} names no digest: another day it may be another image" >&2; test -z "${PINNED}" ;; esac
# Where pip looks, if not in its default place.
ARG PIP_INDEX_URL=
ARG PIP_EXTRA_INDEX_URL=
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /src
COPY locks locks
# everything by its hash
RUN python -m venv /opt/build && /opt/build/bin/pip install -q --no-deps --require-hashes -r locks/build.txt
RUN python -m venv /opt/potserver && /opt/potserver/bin/pip install -q --no-deps --require-hashes -r locks/server.txt
COPY pyproject.toml README.md LICENSE NOTICE ./
COPY potserver potserver
COPY clients clients
COPY schemas schemas
RUN /opt/build/bin/python -m hatchling build -t wheel -d /dist && /opt/potserver/bin/pip install -q --no-deps /dist/*.whl
# what is in the image
RUN /opt/build/bin/cyclonedx-py environment /opt/potserver --pyproject pyproject.toml -o /opt/potserver/sbom.cdx.json

FROM ${BASE}
ARG BASE
LABEL org.opencontainers.image.base.name="${BASE}"
RUN useradd --system --uid 10001 --create-home --home-dir /var/lib/potserver potserver
RUN install -d -m 0700 -o potserver -g potserver /var/lib/potserver /var/cache/potserver
COPY --from=build /opt/potserver /opt/potserver
# compiled numerics are pickled: who can write there can run code as the server
ENV PATH=/opt/potserver/bin:$PATH NUMBA_CACHE_DIR=/var/cache/potserver/numba
USER potserver
WORKDIR /var/lib/potserver
EXPOSE 7447
HEALTHCHECK --interval=10s --timeout=5s --start-period=60s CMD ["potclient", "info", "-e", "tcp/127.0.0.1:7447"]
ENTRYPOINT ["potserver"]
# /var/lib/potserver/maps outlives the container if a volume lies there
CMD ["serve", "-l", "tcp/0.0.0.0:7447", "--store", "/var/lib/potserver/maps"]
