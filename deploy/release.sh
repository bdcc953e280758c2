#!/usr/bin/env bash
# Builds the wheels of a release: `deploy/release.sh FOLDER [x86_64|aarch64]`.
#   …-cp311-abi3-manylinux_….whl  program and package for Linux, for Python 3.11 and every later one
#   …-py3-none-any.whl            the package alone, which pip takes on other systems; only with
#                                 x86_64, since it is the same for all
# Without a second argument it is for this kind of processor. For the other one, first run:
# rustup target add aarch64-unknown-linux-gnu (or x86_64-unknown-linux-gnu)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
[ $# -eq 1 ] || [ $# -eq 2 ] || { sed -n '2,7s/^# //p' "$0" >&2; exit 2; }
mkdir -p "$1"
output=$(cd "$1" && pwd)
target=${2:-$(uname -m)}-unknown-linux-gnu
# The oldest Linux for which MuJoCo has wheels: Debian 10, Ubuntu 20.04, RHEL 8.
oldest=manylinux_2_28

tools=target/release-tools
"${PYO3_PYTHON:-python3}" -m venv "$tools"
"$tools/bin/pip" install --quiet --disable-pip-version-check \
    --require-hashes --requirement deploy/release-tools.txt
# Zig links with the symbols of that system's C library; `check` refuses any other library.
PATH=$(cd "$tools/bin" && pwd):$PATH maturin build --release --locked --strip \
    --target "$target" --zig --compatibility "$oldest" --auditwheel check --out "$output"
if [ "$target" = x86_64-unknown-linux-gnu ]; then
    "$tools/bin/pip" wheel --quiet --disable-pip-version-check --no-deps --no-build-isolation \
        --wheel-dir "$output" ./envs_py
fi
ls -l "$output"
