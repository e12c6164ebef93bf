# g3r-bids as a BIDS App, on the CPU; docs/cohort.md shows how it is built and run.
ARG BASE=python:3.11-slim-bookworm

FROM ${BASE} AS build
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY g3r g3r
COPY data_synth data_synth
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

FROM ${BASE}
# without the CPU build of torch the image grows by gigabytes
ARG PIP_ARGS="--extra-index-url https://download.pytorch.org/whl/cpu"
COPY constraints.txt /constraints.txt
RUN --mount=type=bind,from=build,source=/wheels,target=/wheels \
    pip install --no-cache-dir ${PIP_ARGS} -c /constraints.txt "$(ls /wheels/g3r-*.whl)[dicom]"

# any user may be given (--user), none has a home or a name; compiled kernels are kept on the volume, and all
# else that is written goes to OUT_DIR and /tmp: the root may be read-only
RUN mkdir /cache && chmod 1777 /cache
ENV HOME=/tmp \
    MPLCONFIGDIR=/tmp/matplotlib \
    NUMBA_CACHE_DIR=/cache \
    PYTHONDONTWRITEBYTECODE=1 \
    USER=g3r
VOLUME ["/cache"]
USER 1000:1000
ENTRYPOINT ["g3r-bids"]
CMD ["--help"]
