# shellcheck shell=bash
# Programs of the checks, in versions that do not change. Sourced by the scripts beside it, in the
# project's folder.

# .ci/tools.txt has the versions and hashes.
tools_venv=target/ci-tools-$(sha256sum .ci/tools.txt | cut -c 1-12)
python=${PYO3_PYTHON:-python3}

install_python_tools() {
    ! "$tools_venv/bin/check-jsonschema" --version >/dev/null 2>&1 || return 0
    rm -rf "$tools_venv"
    mkdir -p target
    "$python" -m venv "$tools_venv" || {
        echo "cannot create a virtual environment; on Debian and Ubuntu: apt install python3-venv" >&2
        exit 1
    }
    "$tools_venv/bin/python" -m pip install --quiet --disable-pip-version-check \
        --require-hashes --requirement .ci/tools.txt
}
