# docker build -f docker/client.Dockerfile -t potclient:0.1.0 .
# Name the base image by its digest where builds must repeat: --build-arg BASE=python:3.11-slim-bookworm@sha256:...
# A base without one is told; with --build-arg PINNED=1 it is refused.
ARG BASE=python:3.11-slim-bookworm
FROM ${BASE} AS build
ARG BASE
ARG PINNED=
RUN case "${BASE}" in *@sha256:*) ;; *) echo "${BASE} names no digest: another day it may be another image" >&2; test -z "${PINNED}" ;; esac
ARG PIP_INDEX_URL=
ARG PIP_EXTRA_INDEX_URL=
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /src
COPY locks locks
RUN python -m venv /opt/build && /opt/build/bin/pip install -q --no-deps --require-hashes -r locks/build.txt
RUN python -m venv /opt/potclient && /opt/potclient/bin/pip install -q --no-deps --require-hashes -r locks/client.txt
COPY LICENSE ./
COPY clients clients
COPY schemas schemas
RUN cd clients && /opt/build/bin/python -m hatchling build -t wheel -d /dist && /opt/potclient/bin/pip install -q --no-deps /dist/*.whl
RUN /opt/build/bin/cyclonedx-py environment /opt/potclient --pyproject clients/pyproject.toml -o /opt/potclient/sbom.cdx.json

FROM ${BASE}
ARG BASE
LABEL org.opencontainers.image.base.name="${BASE}"
RUN useradd --system --uid 10001 --create-home --home-dir /var/lib/potclient potclient
COPY --from=build /opt/potclient /opt/potclient
ENV PATH=/opt/potclient/bin:$PATH
USER potclient
WORKDIR /var/lib/potclient
HEALTHCHECK NONE
ENTRYPOINT ["potclient"]
CMD ["--help"]
