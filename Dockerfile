# A container in which the demo and the tests run:
#
#     docker build --tag lare .
#     docker run --rm -it --volume "$PWD/runs:/lare/runs" lare make demo
#     docker run --rm -it lare make test
#
# --build-arg TARGET=setup installs what the tests need into the image too.
FROM python:3.12-slim

# chromium: the tests look at the report; libegl1, libgl1: films of MuJoCo.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends chromium git libegl1 libgl1 make \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /lare
COPY . .
# Runs record the commit, and Git reads no repository of another user.
RUN git config --global --add safe.directory /lare

ARG TARGET=.venv/demo
RUN make "$TARGET"
ENV MUJOCO_GL=egl PATH="/lare/.venv/bin:$PATH"

CMD ["make", "demo"]
