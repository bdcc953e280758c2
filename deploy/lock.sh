#!/usr/bin/env bash
# Locks versions and hashes of Python packages: of those that dmprl installs (envs_py/locks), of the
# tools of the checks (.ci/tools.txt), of CUDA for a check (.ci/cuda.txt), and of the tools of the
# release (deploy/release-tools.txt).
#   deploy/lock.sh            keeps the locked versions where the requirements still permit them
#   deploy/lock.sh --upgrade  takes the newest versions
# Needs a package index: the usual one, or UV_INDEX_URL.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
upgrade=()
case "$*" in
"") ;;
--upgrade) upgrade=(--upgrade) ;;
*) sed -n 2,7p "$0" >&2; exit 2 ;;
esac

uv_version=0.13.9
tools=target/lock-tools-$uv_version
if ! "$tools/bin/uv" --version >/dev/null 2>&1; then
    rm -rf "$tools"
    "${PYO3_PYTHON:-python3}" -m venv "$tools"
    "$tools/bin/pip" install --quiet --disable-pip-version-check "uv==$uv_version"
fi

# Reads requirements from standard input and writes the lock $1, for all supported Pythons and
# processors. The other arguments are those of uv.
lock() {
    "$tools/bin/uv" pip compile --quiet --universal --python-version 3.11 --generate-hashes \
        --no-annotate --custom-compile-command deploy/lock.sh "${upgrade[@]}" \
        --output-file "$1" "${@:2}" - >/dev/null
}

# Prints requirements of a pyproject.toml: of the list that is named by the other arguments.
requirements() {
    "$tools/bin/python" - "$@" <<'PYTHON'
import sys, tomllib

with open(sys.argv[1], "rb") as file:
    node = tomllib.load(file)
for key in sys.argv[2:]:
    node = node[key]
print("\n".join(node))
PYTHON
}

project=envs_py/pyproject.toml
{
    requirements $project project dependencies
    requirements $project project optional-dependencies sim
    requirements $project build-system requires
} | lock envs_py/locks/base.txt
# The optional parts that dmprl installs by itself.
for extra in demos hub rerun search video; do
    requirements $project project optional-dependencies $extra |
        lock envs_py/locks/$extra.txt --constraint envs_py/locks/base.txt
done
lock .ci/tools.txt <.ci/tools.in
lock .ci/cuda.txt <.ci/cuda.in
lock deploy/release-tools.txt <deploy/release-tools.in
