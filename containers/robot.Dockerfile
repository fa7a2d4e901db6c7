# For a robot: ttscompile, numpy and onnxruntime; no torch, no compiler. docs/howto/containers.md has the commands.
FROM debian:bookworm-slim AS packages
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 python3-venv \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /source
COPY CHANGELOG.md LICENSE MANIFEST.in README.md constraints.txt pyproject.toml ./
COPY ttscompile ttscompile
COPY passes passes
COPY runtimes runtimes
COPY plugins/doctor plugins/doctor
COPY plugins/hub plugins/hub
COPY plugins/policies plugins/policies
COPY plugins/rivals plugins/rivals
COPY plugins/serving plugins/serving
ARG PIP_FLAGS=""
RUN python3 -m venv /opt/ttscompile \
    && /opt/ttscompile/bin/python -m pip install --no-cache-dir $PIP_FLAGS -c constraints.txt '.[hub,serve]'

FROM debian:bookworm-slim
RUN apt-get update \
    && apt-get install -y --no-install-recommends ca-certificates python3 \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --create-home robot
COPY --from=packages /opt/ttscompile /opt/ttscompile
ENV PATH=/opt/ttscompile/bin:/usr/local/bin:/usr/bin:/bin
USER robot
WORKDIR /home/robot
ENTRYPOINT ["ttscompile"]
CMD ["doctor"]
