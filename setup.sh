#!/usr/bin/env bash
# Sets up mi_refgs in .venv beside this file, then runs what is asked for. Run it as often as you like.
#
#   bash setup.sh         set up only
#   bash setup.sh demo    set up, then run the main job on an embedded example (writes runs/demo)
#   bash setup.sh test    set up with the development tools, then run every check
#
# Needs Python 3.11 or newer; PYTHON=... names another one than python3. Missing system packages (libllvm19, libatomic1,
# python3-venv; for the tests chromium) are installed when this runs as root or sudo asks for no password; else the line to type is printed.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")"

mode=${1:-}
case "$mode" in
    "" | demo) extras="" options="--no-compile" ;;  # Python compiles what it imports, when it does
    test) extras="[dev]" options="" ;;
    *) echo "usage: bash setup.sh [demo|test]" >&2; exit 2 ;;
esac

fail() { echo "setup.sh: $*" >&2; exit 1; }

# Installs Debian packages, or says how to.
install_packages() {
    local sudo=""
    if [ "$(id -u)" -ne 0 ]; then sudo="sudo"; fi
    if ! command -v apt-get > /dev/null || { [ -n "$sudo" ] && ! sudo -n true 2> /dev/null; }; then
        fail "missing: $*; type: ${sudo:+$sudo }apt-get install $*"
    fi
    echo "setup.sh: installing $*"
    export DEBIAN_FRONTEND=noninteractive
    $sudo apt-get update -qq
    $sudo apt-get install -y -qq "$@" > /dev/null || fail "could not install $*; type: ${sudo:+$sudo }apt-get install $*"
}

# ---------- Python ----------
python=""
for candidate in "${PYTHON:-python3}" python3.13 python3.12 python3.11; do
    if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2> /dev/null; then
        python=$candidate
        break
    fi
done
[ -n "$python" ] || fail "Python 3.11 or newer is missing; type: apt-get install python3"

# ---------- System packages: LLVM compiles Dr.Jit's kernels, libatomic is linked into Dr.Jit ----------
missing=()
if ! found=$("$python" -P mi_refgs/llvm.py); then
    if [ -n "${DRJIT_LIBLLVM_PATH:-}" ] || [ "$(uname)" != "Linux" ]; then fail "$found"; fi
    missing+=(libllvm19)
fi
if [ "$(uname)" = "Linux" ]; then
    "$python" -c 'import ctypes; ctypes.CDLL("libatomic.so.1")' 2> /dev/null || missing+=(libatomic1)
fi
"$python" -c 'import ensurepip, venv' 2> /dev/null || missing+=(python3-venv)
if [ "$mode" = test ] && ! command -v chromium chromium-browser google-chrome > /dev/null; then
    missing+=(chromium)  # tests/viewer/test_viewer.py opens pages in it
fi
if [ ${#missing[@]} -gt 0 ]; then
    install_packages "${missing[@]}"
    found=$("$python" -P mi_refgs/llvm.py) || fail "$found"
fi

# ---------- Packages ----------
# The stamp says what .venv was made for and what it holds; a set-up with the development tools serves every mode.
made_for="$("$python" -VV | tr '\n' ' ') in $PWD"
holds=$(cksum < pyproject.toml)
stamp=.venv/set-up
was=$(cat "$stamp" 2> /dev/null || true)
if [ "$was" != "$made_for: $holds [dev]" ] && [ "$was" != "$made_for: $holds $extras" ]; then
    rm -f "$stamp"
    echo "setup.sh: installing into .venv (a few minutes the first time)"
    case "$was" in
        "$made_for: "*) ;;
        *) "$python" -m venv --clear .venv ;;
    esac
    .venv/bin/python -m pip install -qq --disable-pip-version-check $options -e ".$extras"
    .venv/bin/python -c 'import mi_refgs'
    echo "$made_for: $holds $extras" > "$stamp"
fi

# ---------- What is asked for ----------
case "$mode" in
    "") .venv/bin/refgs doctor ;;
    demo) .venv/bin/refgs demo -o runs/demo ;;
    test)
        failed=""
        .venv/bin/ruff check . || failed+=" ruff-check"
        .venv/bin/ruff format --check . || failed+=" ruff-format"
        # mypy takes half a minute of one core without its cache: the tests do not wait for it.
        .venv/bin/mypy > .venv/mypy.log 2>&1 &
        mypy=$!
        # Two workers, a file at a time: fixtures of a file are made once. In the order of tests/conftest.py: longest first.
        .venv/bin/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder || failed+=" pytest"
        wait "$mypy" || failed+=" mypy"
        cat .venv/mypy.log
        [ -z "$failed" ] || fail "failed:$failed"
        echo "setup.sh: all checks passed"
        ;;
esac
