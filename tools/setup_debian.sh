#!/usr/bin/env bash
# Installs the Debian packages that the named groups need and that are missing. As another user
# than root it prints the command to type instead, and exits with 1. On another system it only
# names the packages.
#
# Usage: bash tools/setup_debian.sh GROUP...      groups: python core sapien annotate teleop
set -euo pipefail

usage() {
    echo "usage: bash tools/setup_debian.sh GROUP... (groups: python core sapien annotate teleop)" >&2
    exit 2
}

packages_of() {
    case "$1" in
        python) echo "python3 python3-venv" ;;
        # Pinocchio's wheel expects it.
        core) echo "libgomp1" ;;
        # SAPIEN draws without a GPU from this Mesa on; Debian 12 has it in its backports only.
        sapien) echo "libvulkan1 mesa-vulkan-drivers>=24.3" ;;
        # Open3D draws through Vulkan, and any Mesa will do.
        annotate)
            echo "libegl1 libgl1 libgomp1 libusb-1.0-0 libvulkan1 mesa-vulkan-drivers" \
                "xauth xdotool xvfb"
            ;;
        # SDL, which pygame-ce brings, looks for these when it opens a window.
        teleop)
            echo "libudev1 libx11-6 libxcursor1 libxext6 libxfixes3 libxi6 libxrandr2 libxss1" \
                "xauth xdotool xvfb"
            ;;
        *) usage ;;
    esac
}

# Whether `name` or `name>=version` is installed.
is_installed() {
    local name=${1%%>=*} found
    found=$(dpkg-query --show --showformat '${db:Status-Status} ${Version}' "$name" 2>/dev/null) ||
        return 1
    case "$found" in
        "installed "*) ;;
        *) return 1 ;;
    esac
    [ "$name" = "$1" ] || dpkg --compare-versions "${found#* }" ge "${1#*>=}"
}

install_packages() {
    DEBIAN_FRONTEND=noninteractive apt-get -o DPkg::Lock::Timeout=300 \
        install --yes --no-install-recommends "$@"
}

# Puts the backports on apt's list, from the mirror that this machine already uses.
add_backports() {
    local suite=$1 mirror
    if [ -n "$(apt-get indextargets "Codename: $suite")" ]; then
        return
    fi
    mirror=$(apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' \
        'Origin: Debian' 'Label: Debian' "Codename: ${suite%-backports}" | head -n 1)
    if [ -z "$mirror" ]; then
        echo "apt has no source for Debian ${suite%-backports}: add $suite to its sources" \
            "by hand, then run this again" >&2
        exit 1
    fi
    echo "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] $mirror $suite main" \
        > "/etc/apt/sources.list.d/$suite.list"
    apt-get update
}

# Installs `name>=version`, from the backports where the distribution's own is older.
install_at_least() {
    local name=${1%%>=*} version=${1#*>=} candidate suite
    candidate=$(apt-cache policy "$name" | awk '/Candidate:/ { print $2 }')
    if dpkg --compare-versions "$candidate" ge "$version"; then
        install_packages "$name"
    else
        suite="$(. /etc/os-release && echo "$VERSION_CODENAME")-backports"
        add_backports "$suite"
        install_packages --target-release "$suite" "$name"
    fi
}

[ $# -gt 0 ] || usage
missing=()
for group in "$@"; do
    names=$(packages_of "$group")
    for name in $names; do
        if ! command -v dpkg-query >/dev/null || ! is_installed "$name"; then
            missing+=("$name")
        fi
    done
done

if [ ${#missing[@]} -eq 0 ]; then
    exit 0
fi
if ! command -v apt-get >/dev/null; then
    echo "This is not a Debian system: have what corresponds to ${missing[*]}" >&2
    exit 0
fi
if [ "$(id -u)" -ne 0 ]; then
    echo "Debian packages are missing: ${missing[*]}" >&2
    echo "Type this, then repeat what you did:" >&2
    echo "    sudo bash tools/setup_debian.sh $*" >&2
    exit 1
fi

apt-get update
plain=()
for name in "${missing[@]}"; do
    case "$name" in
        *">="*) install_at_least "$name" ;;
        *) plain+=("$name") ;;
    esac
done
if [ ${#plain[@]} -gt 0 ]; then
    install_packages "${plain[@]}"
fi
