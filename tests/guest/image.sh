#!/usr/bin/env bash
# image.sh FOLDER: make the guest's disk, kernel and initial disk in FOLDER, where they are not there yet or were made
# of something else. Root.
#
# Two layers, each named by a hash of what it is made of. base-*: Debian 12 with systemd, a PREEMPT_RT kernel, the
# Python packages as wheels. disk-*.ext4: that and this repository, installed and compiled, so that nothing is unpacked
# or compiled under emulation.
set -euo pipefail
umask 022

SOURCE=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
HERE=$SOURCE/tests/guest
FOLDER=$(realpath -m "$1")
HOST_PYTHON=${PYTHON:-python3}
PARTS=(stagectl drivers sim_backend profiles docs deploy pyproject.toml README.md CHANGELOG.md LICENSE) # of install.sh
PACKAGES=systemd,systemd-sysv,udev,dbus,kmod,iproute2,python3,python3-venv,procps,util-linux
MODULES=(net/can drivers/net/can fs/9p net/9p fs/netfs fs/fscache fs/ext4 fs/jbd2 drivers/virtio drivers/block drivers/usb
  drivers/char drivers/tty crypto lib arch/x86/crypto)
# Nothing of this host's settings for Python and pip.
CLEAN=(env -i HOME=/root LANG=C.UTF-8 PATH=/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin)
# Compiled code for every x86-64: the processor that qemu plays is not this one.
GENERIC=("${CLEAN[@]}" STAGECTL_CACHE=/var/cache/stagectl NUMBA_CPU_NAME=generic NUMBA_CPU_FEATURES= OPENBLAS_NUM_THREADS=1)

say() { printf '%4d s  %s\n' "$SECONDS" "$*"; }
hash_of() { sha256sum | cut -c1-12; }
dependencies() { # of the project, one a line
  "$HOST_PYTHON" -c 'import sys, tomllib
print(*tomllib.load(open(sys.argv[1], "rb"))["project"]["dependencies"], sep="\n")' "$SOURCE/pyproject.toml"
}
sources() { (cd "$SOURCE" && find "${PARTS[@]}" -type f ! -path '*/__pycache__/*' ! -path '*.egg-info*' -print0 | LC_ALL=C sort -z); }

MOUNTED=
unmount() {
  [ -z "$MOUNTED" ] || umount "$MOUNTED/dev/shm" "$MOUNTED/dev/pts" "$MOUNTED/dev" "$MOUNTED/proc"
  MOUNTED=
}
trap unmount EXIT
mount_in() {
  MOUNTED=$1
  mount -t proc proc "$1/proc"
  mount --bind /dev "$1/dev"
  mount --bind /dev/pts "$1/dev/pts"
  mount -t tmpfs tmpfs "$1/dev/shm"
}

make_base() { # TO
  local made=$1.part root=$1.part/root kernel version part needed
  say "Debian 12 with systemd"
  rm -rf "$FOLDER"/base-* "$FOLDER"/disk-*
  mkdir -p "$made/debs"
  cat >"$made/kernel.sh" <<'HOOK'
#!/bin/sh -e
cd "$(dirname "$0")/debs"
export APT_CONFIG="$MMDEBSTRAP_APT_CONFIG"
kernel=$(apt-cache depends linux-image-rt-amd64 | sed -n 's/.*Depends: \(linux-image-[0-9].*\)/\1/p' | head -1)
apt-get -q -o APT::Sandbox::User=root download "$kernel"
HOOK
  chmod +x "$made/kernel.sh"
  mmdebstrap --quiet --mode=root --variant=minbase --include="$PACKAGES" \
    --dpkgopt='path-exclude=/usr/share/man/*' --dpkgopt='path-exclude=/usr/share/locale/*' \
    --dpkgopt='path-exclude=/usr/share/doc/*' --aptopt='Acquire::Languages "none"' \
    --customize-hook="$made/kernel.sh" bookworm "$root" "${MIRROR[@]}"

  say "PREEMPT_RT kernel, with the modules of a stage PC"
  kernel=$(basename "$made"/debs/*.deb)
  version=${kernel#linux-image-}
  version=${version%%_*}
  local wanted=(./boot/vmlinuz* "./lib/modules/*/modules.*" "./lib/modules/*/kernel/fs/mbcache.ko")
  for part in "${MODULES[@]}"; do wanted+=("./lib/modules/*/kernel/$part/*"); done
  dpkg-deb --fsys-tarfile "$made/debs/$kernel" |
    tar -x -C "$root" --keep-directory-symlink --transform='s,^\./lib/,./usr/lib/,' --wildcards "${wanted[@]}" || true
  rm -r "$made/debs" "$made/kernel.sh"
  mv "$root/boot/vmlinuz-$version" "$made/vmlinuz"
  chroot "$root" depmod "$version"

  # A small initial disk: Debian's own takes longer to boot than the rest.
  local initrd=$made/initrd.d module
  mkdir -p "$initrd"/{bin,m,dev,proc,sys,root}
  cp /bin/busybox "$initrd/bin/"
  for module in virtio_pci virtio_blk ext4 crc32c_generic; do chroot "$root" modprobe -S "$version" --show-depends "$module"; done |
    awk '$1 == "insmod" && !seen[$2]++ {print $2}' >"$initrd/m/list"
  while read -r module; do cp "$root$module" "$initrd/m/"; done <"$initrd/m/list"
  cat >"$initrd/init" <<'INIT'
#!/bin/busybox sh
b=/bin/busybox
$b mount -t devtmpfs d /dev
while read -r m; do $b insmod /m/${m##*/}; done </m/list
while ! [ -e /dev/vda ]; do $b usleep 10000; done
$b mount -t ext4 -o noatime /dev/vda /root && $b mount -o move /dev /root/dev
exec $b switch_root /root /sbin/init
INIT
  chmod +x "$initrd/init"
  (cd "$initrd" && find . | cpio -o -H newc --quiet) >"$made/initrd"
  rm -r "$initrd"

  say "the Python packages, for a PC without internet"
  mkdir -p "$root/srv/wheels"
  mapfile -t needed < <(dependencies)
  "$HOST_PYTHON" -m pip download -qq --disable-pip-version-check --only-binary=:all: --dest "$root/srv/wheels" \
    --python-version 3.11 --platform manylinux_2_28_x86_64 --platform manylinux_2_27_x86_64 \
    --platform manylinux_2_17_x86_64 --platform manylinux2014_x86_64 'setuptools>=77' wheel "${needed[@]}"

  printf '%s\n' vcan 9p 9pnet_virtio xhci_pci ftdi_sio >"$root/etc/modules-load.d/guest.conf"
  echo stagepc >"$root/etc/hostname"
  cat >"$root/etc/systemd/system/guest-test.service" <<'UNIT'
[Unit]
Description=What the host's share holds, as root
DefaultDependencies=no
Requires=basic.target
After=basic.target dbus.service systemd-modules-load.service
[Service]
Type=oneshot
TimeoutStartSec=infinity
Environment=HOME=/root PATH=/usr/local/bin:/usr/sbin:/usr/bin
ExecStartPre=/bin/mount --mkdir -t 9p -o trans=virtio,version=9p2000.L,cache=none share /mnt/share
ExecStart=/bin/sh -c 'python3 -u /mnt/share/checks.py >>/mnt/share/log 2>&1; echo $? >/mnt/share/exit_code'
ExecStopPost=/bin/sh -c 'sync; systemctl poweroff -ff'
[Install]
WantedBy=multi-user.target
UNIT
  chroot "$root" systemctl -q enable guest-test.service
  chroot "$root" systemctl -q mask getty@tty1.service serial-getty@ttyS0.service systemd-timesyncd.service \
    apt-daily.timer apt-daily-upgrade.timer
  mv "$made" "$1"
}

# The same release under an older name, to upgrade from: what install.sh would make of these sources with one more line.
make_release_before() { # ROOT
  local root=$1 name before
  name=$(readlink "$root/opt/stagectl/current")
  cp -a "$root/srv/stagectl" "$root/srv/before"
  echo "The release before." >>"$root/srv/before/CHANGELOG.md"
  before=$("${CLEAN[@]}" DESTDIR="$root/srv/try" "$root/srv/before/deploy/install.sh" install | sed -n 's/^release \(.*\) made$/\1/p')
  rm -r "$root/srv/try"
  cp -al "$root/opt/stagectl/$name" "$root/opt/stagectl/$before"
  cp --remove-destination "$root/srv/before/CHANGELOG.md" "$root/opt/stagectl/$before/"
  grep -rlIZ --include='*' -e "$name" "$root/opt/stagectl/$before/venv/bin" "$root/opt/stagectl/$before/venv/pyvenv.cfg" \
    "$root/opt/stagectl/$before"/venv/lib/python3*/site-packages/{__editable__*,stagectl-*} | xargs -0 sed -i "s/$name/$before/g"
}

# Never through what a build that was killed left mounted there: that is this host's /dev.
remove() { # FOLDER
  local place
  while read -r place; do umount "$place"; done < <(awk -v at="$1/" 'index($2, at) == 1 {print $2}' /proc/mounts | sort -r)
  rm -rf --one-file-system "$1"
}

make_disk() { # BASE TO
  local root=$FOLDER/root
  say "this repository, installed"
  remove "$root"
  rm -rf "$FOLDER"/disk-*
  cp -a "$1/root" "$root"
  mkdir -p "$root/srv/stagectl"
  (cd "$SOURCE" && sources | tar --null -c -T -) | tar -C "$root/srv/stagectl" -x
  mount_in "$root"
  chroot "$root" "${CLEAN[@]}" /srv/stagectl/deploy/install.sh install --wheels /srv/wheels
  say "compiled"
  mkdir "$root/srv/guest"
  cp "$HERE"/{warm.py,stage-100hz.toml,machine.toml} "$root/srv/guest/"
  chroot "$root" "${GENERIC[@]}" /opt/stagectl/current/venv/bin/python /srv/guest/warm.py /srv/runs
  unmount
  # Compiled code is known by its source's path and time of change, to the nanosecond, and mke2fs keeps whole seconds only.
  tar --format=posix -C "$root/var/cache/stagectl" -cf "$root/srv/cache.tar" .
  make_release_before "$root"
  # The releases stay, so that nothing has to be unpacked under emulation; all else is the guest's own to install.
  mv "$root/opt/stagectl" "$root/srv/releases"
  rm "$root/srv/releases/current"
  chroot "$root" "${CLEAN[@]}" /srv/stagectl/deploy/install.sh uninstall --yes
  rm -r "$root/srv/wheels"
  say "the disk"
  truncate -s $(($(du -sm "$root" | cut -f1) + 700))M "$FOLDER/disk.part"
  mke2fs -q -F -t ext4 -O ^has_journal -d "$root" "$FOLDER/disk.part"
  remove "$root"
  mv "$FOLDER/disk.part" "$2"
}

trap 'exit 130' INT
trap 'exit 143' TERM HUP
mkdir -p "$FOLDER"
# The host's own mirror, where it is a Debian 12 itself.
MIRROR=(http://deb.debian.org/debian)
if grep -qs VERSION_CODENAME=bookworm /etc/os-release; then
  for list in /etc/apt/sources.list.d/debian.sources /etc/apt/sources.list; do
    if [ -s "$list" ]; then
      MIRROR=("$list")
      break
    fi
  done
fi
base=$FOLDER/base-$({ sed '/^make_release_before/,$d' "${BASH_SOURCE[0]}" && dependencies; } | hash_of)
disk=$FOLDER/disk-$({ cat "${BASH_SOURCE[0]}" "$HERE"/{warm.py,machine.toml,stage-100hz.toml} && cd "$SOURCE" &&
  sources | xargs -0 sha256sum; } | hash_of).ext4
[ -d "$base" ] || {
  for old in "$FOLDER"/base-*; do remove "$old"; done
  make_base "$base"
}
[ -s "$disk" ] || make_disk "$base" "$disk"
ln -sfn "$(basename "$base")/vmlinuz" "$FOLDER/vmlinuz"
ln -sfn "$(basename "$base")/initrd" "$FOLDER/initrd"
ln -sfn "$(basename "$disk")" "$FOLDER/disk"
