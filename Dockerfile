# kros in a container, from the locked packages alone:  docker build -t kros .  &&  docker run --rm -v "$PWD:/work" kros init recordings
FROM python:3.12-slim

WORKDIR /opt/kros
COPY requirements.lock pyproject.toml README.md LICENSE ./
RUN pip install --no-cache-dir --disable-pip-version-check --require-hashes -r requirements.lock
COPY src src
RUN pip install --no-cache-dir --disable-pip-version-check --no-deps --no-build-isolation --no-index . \
    && useradd --create-home engineer && mkdir /work && chown engineer /work

USER engineer
WORKDIR /work
ENTRYPOINT ["kros"]
CMD ["demo"]
