# The two commands of the README in a container: `docker build -t r2h_batch .`, then `docker run r2h_batch` runs `make test`.
# Without a GPU add --build-arg PIP_EXTRA_INDEX_URL=URL with PyTorch's CPU index, which saves some GB of CUDA packages.
FROM python:3.12-slim-bookworm
ARG PIP_EXTRA_INDEX_URL
RUN apt-get update \
    && apt-get install -y --no-install-recommends chromium git libegl1 libosmesa6 make \
    && rm -rf /var/lib/apt/lists/*
ENV MUJOCO_GL=osmesa
WORKDIR /r2h_batch
COPY . .
RUN make demo
CMD ["make", "test"]
