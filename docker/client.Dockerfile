# docker build -f docker/client.Dockerfile -t potclient:0.1.0 .
FROM python:3.11-slim-bookworm AS build
ARG PIP_INDEX_URL=
ARG PIP_EXTRA_INDEX_URL=
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /src
RUN python -m venv /opt/potclient
COPY constraints.txt LICENSE ./
COPY clients clients
COPY schemas schemas
RUN /opt/potclient/bin/pip install -q -c constraints.txt ./clients

FROM python:3.11-slim-bookworm
RUN useradd --system --uid 10001 --create-home --home-dir /var/lib/potclient potclient
COPY --from=build /opt/potclient /opt/potclient
ENV PATH=/opt/potclient/bin:$PATH
USER potclient
WORKDIR /var/lib/potclient
HEALTHCHECK NONE
ENTRYPOINT ["potclient"]
CMD ["--help"]
