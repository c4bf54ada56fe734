#!/usr/bin/env bash
# Makes .venv ready: finds Python 3.11, 3.12 or 3.13, adds missing system libraries (as root), installs the pinned
# requirements and the packages in src/, editable. Does nothing when all of that is as it should be. Every make target
# that runs Python calls it.
#   PYTHON          the interpreter to use instead of searching for one
#   TORCH_INDEX     where to look first for a build of torch without CUDA
#   XDG_CACHE_HOME  where the wheel of pybullet is kept if it had to be compiled (default ~/.cache)
set -euo pipefail
cd "$(dirname "$0")/.."

# soname and the Debian package that holds it: what Open3D's wheel links to and does not bring along
SYSTEM_LIBRARIES="libusb-1.0.so.0:libusb-1.0-0 libGL.so.1:libgl1 libEGL.so.1:libegl1 libX11.so.6:libx11-6
    libidn2.so.0:libidn2-0 libudev.so.1:libudev1"
TORCH_INDEX=${TORCH_INDEX:-https://download.pytorch.org/whl/cpu}
VERSIONS="3.11 3.12 3.13"
VERSIONS_IN_WORDS="Python 3.11, 3.12 or 3.13"
WHEELS=${XDG_CACHE_HOME:-$HOME/.cache}/active6d/wheels

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

# version_of INTERPRETER: prints major and minor version, or nothing
version_of() { "$1" -V 2>/dev/null | sed -nE 's/^Python ([0-9]+\.[0-9]+)\..*/\1/p'; }

# find_python: prints the first interpreter of a version that is supported
find_python() {
    local candidate
    for candidate in ${PYTHON:-python3.11 python3.12 python3 python3.13 "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3.1[123]*/bin/python3}; do
        if grep -q -w -F "$(version_of "$candidate" | grep . || echo none)" <<<"$VERSIONS"; then
            echo "$candidate"
            return
        fi
    done
    return 1
}

ensure_python() {
    local version
    if ! python=$(find_python); then
        [ -z "${PYTHON:-}" ] || fail "PYTHON=$PYTHON is not $VERSIONS_IN_WORDS"
        for version in $VERSIONS; do
            [ "$(apt-cache policy "python$version" 2>/dev/null | grep -c 'Candidate: [0-9]')" -eq 1 ] || continue
            install_system "python$version" "python$version-venv"
            break
        done
        python=$(find_python) || fail "$VERSIONS_IN_WORDS is needed and none was found;" \
            "install it (pyenv install 3.12, or your system's package python3.12) or set PYTHON"
    fi
    # Debian splits ensurepip off
    "$python" -c 'import ensurepip, venv' 2>/dev/null || install_system "python$(version_of "$python")-venv"
}

ensure_system_libraries() {
    local entry missing=() known
    known=$(PATH=$PATH:/sbin:/usr/sbin ldconfig -p)
    for entry in $SYSTEM_LIBRARIES; do
        grep -q -F "${entry%%:*} " <<<"$known" || missing+=("${entry##*:}")
    done
    [ ${#missing[@]} -eq 0 ] || install_system "${missing[@]}"
}

# pybullet has wheels up to Python 3.11. For later versions it is compiled once, and the wheel is kept.
ensure_pybullet() {
    local pin missing=()
    pin=$(grep '^pybullet==' requirements.txt)
    mkdir -p "$WHEELS"
    .venv/bin/pip install -qq --no-deps --only-binary :all: --find-links "$WHEELS" "$pin" 2>/dev/null && return
    g++ --version >/dev/null 2>&1 || missing+=(g++)
    "$python" -c 'import os, sysconfig; os.stat(os.path.join(sysconfig.get_path("include"), "Python.h"))' 2>/dev/null ||
        missing+=("python$(version_of "$python")-dev")
    [ ${#missing[@]} -eq 0 ] || install_system "${missing[@]}"
    say "$pin has no wheel for $("$python" -V): compiling it once (about ten minutes); the wheel is kept in $WHEELS"
    .venv/bin/pip wheel -qq --no-deps --wheel-dir "$WHEELS" "$pin" || fail "$pin could not be compiled; see the messages above"
    .venv/bin/pip install -qq --no-deps --no-index --find-links "$WHEELS" "$pin"
}

# The environment is there, has what the requirements ask for, and is of the version that PYTHON names.
is_up_to_date() {
    [ "$1" = "$(cat .venv/requirements.sha256 2>/dev/null)" ] || return 1
    [ -z "${PYTHON:-}" ] || [ "$(version_of "$PYTHON")" = "$(version_of .venv/bin/python)" ]
}

ensure_requirements() {
    local wanted
    wanted=$( (pwd; cat requirements.txt requirements-dev.txt constraints.txt) | sha256sum)
    ! is_up_to_date "$wanted" || return 0
    [ "$(uname -s)-$(uname -m)" = Linux-x86_64 ] || fail "the ROS 2 wheels exist for Linux on x86-64 only; see docs/install.md"
    ensure_python
    ensure_system_libraries
    say "making .venv with $("$python" -V) and installing requirements.txt and requirements-dev.txt (some minutes)"
    "$python" -m venv --clear .venv
    ensure_pybullet
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
