#!/usr/bin/env bash
# Makes .venv ready: finds Python 3.11, adds missing system libraries (as root), installs the pinned requirements and the
# five packages, editable. Does nothing when all of that is as it should be. Called by every make target that runs Python.
#   PYTHON       the interpreter to use instead of searching for one
#   TORCH_INDEX  where to look first for a build of torch without CUDA
set -euo pipefail
cd "$(dirname "$0")/.."

# soname and the Debian package that holds it: what Open3D's wheel links to and does not bring along
SYSTEM_LIBRARIES="libusb-1.0.so.0:libusb-1.0-0 libGL.so.1:libgl1 libEGL.so.1:libegl1 libX11.so.6:libx11-6
    libidn2.so.0:libidn2-0 libudev.so.1:libudev1"
TORCH_INDEX=${TORCH_INDEX:-https://download.pytorch.org/whl/cpu}

quiet=()
[ -t 1 ] || quiet=(-qq)

say() { printf 'setup: %s\n' "$*"; }
fail() { printf 'setup: %s\n' "$*" >&2; exit 1; }

# install_system PACKAGE...: with apt-get as root, else stops and says what to type
install_system() {
    command -v apt-get >/dev/null || fail "these Debian packages, by their name on this system, are missing: $*"
    [ "$(id -u)" -eq 0 ] || fail "missing system packages; please run: sudo apt-get install $*"
    say "installing system packages: $*"
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >/dev/null
}

# find_python: prints the first interpreter that is Python 3.11
find_python() {
    local candidate
    for candidate in ${PYTHON:-python3.11 python3 "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3.11*/bin/python3}; do
        if "$candidate" -c 'import sys; raise SystemExit(sys.version_info[:2] != (3, 11))' 2>/dev/null; then
            echo "$candidate"
            return
        fi
    done
    return 1
}

ensure_python() {
    if ! python=$(find_python); then
        [ -z "${PYTHON:-}" ] || fail "PYTHON=$PYTHON is not Python 3.11"
        [ "$(apt-cache policy python3.11 2>/dev/null | grep -c 'Candidate: [0-9]')" -eq 1 ] ||
            fail "Python 3.11 is needed and none was found; install it (pyenv install 3.11, or your system's package) or set PYTHON"
        install_system python3.11 python3.11-venv
        python=$(find_python)
    fi
    # Debian splits ensurepip off
    "$python" -c 'import ensurepip, venv' 2>/dev/null || install_system python3.11-venv
}

ensure_system_libraries() {
    local entry missing=() known
    known=$(PATH=$PATH:/sbin:/usr/sbin ldconfig -p)
    for entry in $SYSTEM_LIBRARIES; do
        grep -q -F "${entry%%:*} " <<<"$known" || missing+=("${entry##*:}")
    done
    [ ${#missing[@]} -eq 0 ] || install_system "${missing[@]}"
}

ensure_requirements() {
    local wanted
    wanted=$( (pwd; cat requirements.txt requirements-dev.txt constraints.txt) | sha256sum)
    [ "$wanted" = "$(cat .venv/requirements.sha256 2>/dev/null)" ] && return
    [ "$(uname -s)-$(uname -m)" = Linux-x86_64 ] || fail "the ROS 2 wheels exist for Linux on x86-64 only; see docs/install.md"
    ensure_python
    ensure_system_libraries
    say "making .venv with $("$python" -V) and installing requirements.txt and requirements-dev.txt (some minutes)"
    "$python" -m venv --clear .venv
    .venv/bin/pip install -qq --no-deps --retries 0 --timeout 5 --index-url "$TORCH_INDEX" "$(grep '^torch==' requirements.txt)" 2>/dev/null ||
        say "no torch at $TORCH_INDEX; taking the default index's (with CUDA, much larger)"
    .venv/bin/pip install "${quiet[@]}" --use-pep517 -r requirements.txt -r requirements-dev.txt
    echo "$wanted" >.venv/requirements.sha256
}

ensure_packages() {
    local wanted
    wanted=$(cat .venv/requirements.sha256 src/*/setup.py | sha256sum)
    [ "$wanted" = "$(cat .venv/packages.sha256 2>/dev/null)" ] && return
    .venv/bin/pip install -qq --no-deps --no-build-isolation --use-pep517 $(printf -- '-e %s ' src/active6d_*)
    echo "$wanted" >.venv/packages.sha256
}

ensure_requirements
ensure_packages
