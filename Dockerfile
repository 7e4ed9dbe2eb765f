# docker build -t slipguard . && docker run --rm slipguard            ten simulated lifts
# For a cell (devices, priority, volumes) see systemd/README.md.
FROM python:3.11-slim-bookworm AS build
COPY . /source
RUN python -m venv /opt/slipguard && /opt/slipguard/bin/pip install --no-cache-dir /source

FROM python:3.11-slim-bookworm
COPY --from=build /opt/slipguard /opt/slipguard
# The ids are Debian's; the daemon needs the groups to open cameras and the serial adapter.
RUN useradd --system --groups dialout,video --home-dir /var/lib/slipguard --create-home slipguard \
    && install --directory --owner=slipguard --group=dialout /run/slipguard
ENV PATH=/opt/slipguard/bin:$PATH STATE_DIRECTORY=/var/lib/slipguard RUNTIME_DIRECTORY=/run/slipguard ORT_DISABLE_TELEMETRY=1
USER slipguard
VOLUME /var/lib/slipguard
ENTRYPOINT ["slipguard"]
CMD ["--sim"]
