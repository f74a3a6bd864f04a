# docker build -f docker/server.Dockerfile -t potserver:0.1.0 .
FROM python:3.11-slim-bookworm AS build
# Where pip looks, if not in its default place.
ARG PIP_INDEX_URL=
ARG PIP_EXTRA_INDEX_URL=
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /src
RUN python -m venv /opt/potserver
COPY pyproject.toml constraints.txt README.md LICENSE NOTICE ./
COPY potserver potserver
COPY clients clients
COPY schemas schemas
RUN /opt/potserver/bin/pip install -q -c constraints.txt '.[ros]'

FROM python:3.11-slim-bookworm
RUN useradd --system --uid 10001 --create-home --home-dir /var/lib/potserver potserver
COPY --from=build /opt/potserver /opt/potserver
ENV PATH=/opt/potserver/bin:$PATH NUMBA_CACHE_DIR=/var/lib/potserver/numba-cache
USER potserver
WORKDIR /var/lib/potserver
EXPOSE 7447
HEALTHCHECK --interval=10s --timeout=5s --start-period=60s CMD ["potclient", "info", "-e", "tcp/127.0.0.1:7447"]
ENTRYPOINT ["potserver"]
# /var/lib/potserver/maps outlives the container if a volume lies there
CMD ["serve", "-l", "tcp/0.0.0.0:7447", "--store", "/var/lib/potserver/maps"]
