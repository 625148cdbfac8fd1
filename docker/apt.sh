#!/usr/bin/env bash
# Installs what Debian and Ubuntu must provide: a compiler, venv, and Mesa's software Vulkan driver for SAPIEN.
# Does nothing without root or without apt. A machine without the Vulkan driver still runs everything but the simulator.
set -euo pipefail

if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then
    echo "seamark: not root or no apt: assuming python3.11-venv, a C++ compiler, cmake and a Vulkan driver are there" >&2
    exit 0
fi
export DEBIAN_FRONTEND=noninteractive

installed() { dpkg-query -W -f='${Status}\n' "$@" 2>/dev/null | grep -c '^install ok installed$'; }

base=(build-essential cmake ninja-build python3.11-dev python3.11-venv libvulkan1 libgl1 libegl1 libx11-6 libxext6)
if [ "$(installed "${base[@]}" || true)" != "${#base[@]}" ]; then
    apt-get update -qq
    apt-get install -y -qq --no-install-recommends "${base[@]}" >/dev/null
fi

# SAPIEN needs lavapipe 25 or newer; Debian 12 has that in backports, derived here from the machine's own sources.
mesa_major() { dpkg-query -W -f='${Version}' mesa-vulkan-drivers 2>/dev/null | cut -d. -f1; }
mesa="$(mesa_major || true)"
if [ "${mesa:-0}" -lt 25 ]; then
    . /etc/os-release
    from=()
    if [ "${VERSION_CODENAME:-}" = bookworm ] && [ -f /etc/apt/sources.list.d/debian.sources ]; then
        awk 'BEGIN{RS=""} NR==1' /etc/apt/sources.list.d/debian.sources |
            sed -E 's/^Suites:.*/Suites: bookworm-backports/' >/etc/apt/sources.list.d/seamark-backports.sources
        from=(-t bookworm-backports)
    fi
    { apt-get update -qq && apt-get install -y -qq --no-install-recommends "${from[@]}" mesa-vulkan-drivers >/dev/null; } ||
        echo "seamark: Mesa's Vulkan driver could not be installed; the simulator will say so, all else works" >&2
fi
