#!/usr/bin/env bash
# Builds a release for one Python and this kind of machine: `deploy/release.sh FOLDER`.
# It consists of a wheel, and an archive of the program with its Python package. The Python is
# PYO3_PYTHON, or else python3. Both files need the libpython of that minor version: the system's, a
# conda environment's, or one in LD_LIBRARY_PATH.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
[ $# -eq 1 ] || { sed -n 2,5p "$0" >&2; exit 2; }
mkdir -p "$1"
output=$(cd "$1" && pwd)
export PYO3_PYTHON=${PYO3_PYTHON:-$(command -v python3)}

tools=target/release-tools
"$PYO3_PYTHON" -m venv "$tools"
"$tools/bin/pip" install --quiet --disable-pip-version-check \
    --require-hashes --requirement deploy/release-tools.txt
# Without auditwheel, which would add a second libpython to the wheel.
"$tools/bin/maturin" build --release --locked --interpreter "$PYO3_PYTHON" \
    --compatibility linux --auditwheel skip --out "$output"

python=$("$PYO3_PYTHON" -c 'import sys; print("python%d.%d" % sys.version_info[:2])')
version=$(sed -n 's/^version = "\(.*\)"/\1/p' pyproject.toml)
name=dmprl-$version-$(uname -m)-linux-$python
stage=$(mktemp -d)
trap 'rm -rf "$stage"' EXIT
mkdir "$stage/$name"
install -s target/release/dmprl "$stage/$name/dmprl"
cp README.md CHANGELOG.md LICENSE-* "$stage/$name/"
git archive HEAD envs_py | tar -x -C "$stage/$name"
tar -czf "$output/$name.tar.gz" -C "$stage" "$name"
ls -l "$output"
