#!/usr/bin/env bash
# Make .venv from the hash-pinned lock, and see that the system libraries are there. Called by `make setup`.
set -euo pipefail
cd "$(dirname "$0")/.."
say() { printf '%s\n' "$*" >&2; }

PYTHON=${PYTHON:-python3}
fits='import sys; sys.exit(not ((3, 11) <= sys.version_info[:2] <= (3, 13)))'
if ! "$PYTHON" -c "$fits" 2>/dev/null; then
  PYTHON=""
  for name in python3.13 python3.12 python3.11; do
    if "$name" -c "$fits" 2>/dev/null; then PYTHON=$name; break; fi
  done
  if [ -z "$PYTHON" ]; then
    say "fabctl needs Python 3.11, 3.12 or 3.13, and finds $(python3 --version 2>/dev/null || echo none)."
    say "Debian 12:    sudo apt-get install python3 python3-venv"
    say "Ubuntu 24.04: sudo apt-get install python3 python3-venv"
    say "Ubuntu 22.04: sudo add-apt-repository ppa:deadsnakes/ppa && sudo apt-get install python3.11 python3.11-venv"
    say "then: make setup PYTHON=python3.11"
    exit 2
  fi
fi

# open3d needs these at import; a bare Debian has none of them.
missing=()
for pair in libEGL.so.1:libegl1 libGL.so.1:libgl1 libX11.so.6:libx11-6 libusb-1.0.so.0:libusb-1.0-0 libgomp.so.1:libgomp1; do
  "$PYTHON" -c "import ctypes; ctypes.CDLL('${pair%%:*}')" 2>/dev/null || missing+=("${pair##*:}")
done
if [ ${#missing[@]} -gt 0 ]; then
  install="apt-get install -y --no-install-recommends ${missing[*]}"
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    say "installing the system libraries that open3d needs: ${missing[*]}"
    export DEBIAN_FRONTEND=noninteractive
    $install >/dev/null 2>&1 || { apt-get update -qq >/dev/null && $install >/dev/null; }
  elif sudo -n true 2>/dev/null; then
    say "installing the system libraries that open3d needs: ${missing[*]}"
    sudo -n $install >/dev/null 2>&1 || { sudo -n apt-get update -qq >/dev/null && sudo -n $install >/dev/null; }
  else
    say "open3d needs system libraries that are missing here; type this once, then make setup again:"
    say "  sudo $install"
    exit 2
  fi
fi

if [ ! -x .venv/bin/python ] || ! .venv/bin/python -c "$fits" 2>/dev/null; then
  if ! "$PYTHON" -m venv --clear .venv; then
    say "this Python cannot make environments; type: sudo apt-get install python3-venv, then make setup again"
    exit 2
  fi
fi
# pip comes with the environment and brings uv, pinned and hash-checked like everything else.
if [ "$(.venv/bin/uv --version 2>/dev/null | cut -d' ' -f2)" != "$UV_VERSION" ]; then
  pin=$(mktemp)
  trap 'rm -f "$pin"' EXIT
  awk -v want="uv==$UV_VERSION" 'index($0, want) == 1 {on = 1} on {print} on && !/\\$/ {exit}' requirements.lock >"$pin"
  .venv/bin/python -m pip install -q --disable-pip-version-check --require-hashes -r "$pin"
fi
.venv/bin/uv pip sync -q --python .venv/bin/python --require-hashes requirements.lock
.venv/bin/uv pip install -q --python .venv/bin/python --no-deps --no-build-isolation -e .
touch .venv/.done
say "ready: .venv/bin/fabctl"
