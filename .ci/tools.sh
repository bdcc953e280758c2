# shellcheck shell=bash
# Programs of the checks, in versions that do not change. Sourced by the scripts beside it, in the
# project's folder.

# .ci/tools.txt has the versions and hashes.
tools_venv=target/ci-tools-$(sha256sum .ci/tools.txt | cut -c 1-12)
deny_version=0.20.2
deny_root=target/cargo-deny-$deny_version
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

install_cargo_deny() {
    ! "$deny_root/bin/cargo-deny" --version >/dev/null 2>&1 || return 0
    # Unoptimised, because compiling it takes longer than running it.
    CARGO_TARGET_DIR=$deny_root/build CARGO_PROFILE_DEV_DEBUG=0 cargo install --quiet --locked \
        --debug --root "$deny_root" --version "=$deny_version" cargo-deny
    rm -rf "$deny_root/build"
}
