#!/usr/bin/env bash
# Usage: setup.sh PYTHON VENV - a virtual environment with mitsim (editable) and its tests, and an LLVM it can use.
# What needs root is installed by apt when we are root; otherwise the command to type is printed and we stop.
set -euo pipefail
python=$1 venv=$2
cd "$(dirname "$0")/.."

need() { # need REASON PACKAGE: install a Debian package, or say how
    if [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null; then
        echo "setup: $1; installing $2" >&2
        apt-get -qq update >&2
        DEBIAN_FRONTEND=noninteractive apt-get -qq install -y "$2" >/dev/null
    elif command -v apt-get >/dev/null; then
        stop "$1" "sudo apt-get update && sudo apt-get install -y $2"
    else
        stop "$1" "install the package that your system has in place of Debian's $2"
    fi
}

stop() { # stop REASON COMMAND
    printf 'setup: %s. Type this, then make setup again:\n    %s\n' "$1" "$2" >&2
    exit 1
}

command -v "$python" >/dev/null || need "$python is missing" python3-venv
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))' ||
    stop "$("$python" --version) is too old, 3.10 or newer is needed" "make setup PYTHON=python3.12"

if ! [ -x "$venv/bin/python" ] || ! "$venv/bin/python" -m pip --version >/dev/null 2>&1; then
    # Debian keeps ensurepip, without which a new environment has no pip, in a package of its own.
    "$python" -c 'import venv, ensurepip' 2>/dev/null || need "Python cannot make environments" python3-venv
    "$python" -m venv "$venv"
fi

echo "setup: installing mitsim into $venv" >&2
# Byte code is written when a module is first used; writing it all here costs 150 MB.
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-compile -e '.[test]'

llvm() { "$venv/bin/python" -c 'from mitsim.core.environment import find_llvm; find_llvm()' 2>/dev/null; }
llvm || need "no LLVM library of version 17 or newer works here" libllvm19
llvm || stop "the LLVM library still does not work" "$venv/bin/mitsim doctor"
