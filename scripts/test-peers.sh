#!/usr/bin/env bash
# Install and build what the tests hold the tool against: a rig on libmodbus, mbpoll, and Chromium for the report's page.
# Never fails: without them the tests that need them are skipped, with the reason.
cd "$(dirname "$0")/.."
out=build/peers
mkdir -p "$out"

missing=()
command -v cc >/dev/null || missing+=(gcc libc6-dev)
[ -e /usr/include/modbus/modbus.h ] || missing+=(libmodbus-dev)
command -v mbpoll >/dev/null || missing+=(mbpoll)
command -v pkg-config >/dev/null || missing+=(pkg-config)

[ -x /usr/bin/chromium ] || missing+=(chromium)

if [ ${#missing[@]} -gt 0 ]; then
  install="apt-get install -y --no-install-recommends ${missing[*]}"
  root=""
  [ "$(id -u)" -eq 0 ] || root="sudo -n"
  if command -v apt-get >/dev/null && { [ -z "$root" ] || $root true 2>/dev/null; }; then
    DEBIAN_FRONTEND=noninteractive $root $install >"$out/install.log" 2>&1 || {
      $root apt-get update >>"$out/install.log" 2>&1
      DEBIAN_FRONTEND=noninteractive $root $install >>"$out/install.log" 2>&1 ||
        echo "test peers: could not install ${missing[*]} (see $out/install.log); their tests are skipped"
    }
  else
    echo "test peers: missing ${missing[*]}; for their tests type: sudo $install"
  fi
fi

source=tests/peers/libmodbus_rig.c
if command -v cc >/dev/null && [ -e /usr/include/modbus/modbus.h ]; then
  if [ ! -x "$out/libmodbus_rig" ] || [ "$source" -nt "$out/libmodbus_rig" ]; then
    cc -O2 -Wall -Wextra -I/usr/include/modbus "$source" -o "$out/libmodbus_rig" -lmodbus ||
      echo "test peers: $source does not compile here; its tests are skipped"
  fi
fi
exit 0
