# The README's installation in a container, for commands and as a dev container; see docs/how-to/install.md.
FROM debian:bookworm-slim

# Python 3.11, make and its compiler, and Mesa's EGL for images without a display.
RUN apt-get update \
    && apt-get install -y --no-install-recommends \
       ca-certificates g++ git libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0 make python3 python3-venv \
    && rm -rf /var/lib/apt/lists/*

RUN useradd --create-home arms && install -d -o arms -g arms /home/arms/dual_ur10
USER arms
WORKDIR /home/arms/dual_ur10
RUN python3 -m venv /home/arms/venv
ENV PATH=/home/arms/venv/bin:$PATH OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1

# The index of CPU builds that PyTorch's installation page names; constraints.txt pins one of them.
ARG PIP_EXTRA_INDEX_URL
COPY --chown=arms . .
RUN pip install --no-cache-dir -c constraints.txt -e packages/ur-core -e packages/ur-emulator -e ".[train,live,virtual,plot]"

CMD ["python", "-m", "dual_ur10", "list"]
