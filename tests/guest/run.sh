#!/usr/bin/env bash
# run.sh: prove stagectl on a stage PC in a box. Boots a Debian guest with a PREEMPT_RT kernel, systemd, a CAN interface and
# a serial line, and runs checks.py in it; prints what it says. Exit code: that of the checks, 125 where there was none.
# Root, Debian or alike. Installs what it needs with apt; keeps the image in $XDG_CACHE_HOME/stagectl-guest.
set -euo pipefail
HERE=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
FOLDER=${XDG_CACHE_HOME:-$HOME/.cache}/stagectl-guest
LIMIT_S=${GUEST_LIMIT_S:-1200}

[[ $EUID -eq 0 ]] || {
  echo "guest-test makes a disk image and has to be root: sudo make guest-test" >&2
  exit 77
}
needed=()
for package in qemu-system-x86 mmdebstrap busybox-static e2fsprogs cpio kmod; do
  dpkg -s "$package" 2>/dev/null | grep -q '^Status: install ok installed' || needed+=("$package")
done
if [[ ${#needed[@]} -gt 0 ]]; then
  export DEBIAN_FRONTEND=noninteractive
  apt-get -q update
  apt-get -q install --yes --no-install-recommends "${needed[@]}"
fi
"$HERE/image.sh" "$FOLDER"

# The interferometer's line: ttyS1 of the guest writes, an FTDI adapter reads; they are one wire. The processor's
# virtualisation where it is there, emulation else: nothing here is judged by its speed.
accelerated=(-accel "tcg,thread=multi")
if [[ -w /dev/kvm ]] && grep -qsE '^flags.* (svm|vmx)( |$)' /proc/cpuinfo; then accelerated=(-accel kvm); fi
share=$FOLDER/share
rm -rf "$share" "$FOLDER/wire" "$FOLDER/console"
mkdir "$share"
cp "$HERE"/*.py "$HERE"/*.toml "$share/"
printf '%s\n' "${GUEST_CHECKS:-}" >"$share/only"
: >"$share/log"
timeout "$LIMIT_S" qemu-system-x86_64 "${accelerated[@]}" -cpu max -smp 2 -m 3072 \
  -display none -no-reboot -nic none -monitor none \
  -kernel "$FOLDER/vmlinuz" -initrd "$FOLDER/initrd" \
  -append "console=ttyS0 root=/dev/vda rw quiet loglevel=4 systemd.show_status=0 panic=-1 mitigations=off random.trust_cpu=on audit=0 apparmor=0 net.ifnames=0 isolcpus=1" \
  -drive "file=$FOLDER/disk,if=virtio,format=raw,snapshot=on" \
  -virtfs "local,path=$share,mount_tag=share,security_model=none,multidevs=remap" \
  -chardev "socket,id=a,path=$FOLDER/wire,server=on,wait=off" -chardev "socket,id=b,path=$FOLDER/wire" \
  -serial "file:$FOLDER/console" -serial chardev:a \
  -device qemu-xhci -device usb-serial,chardev=b,serial=LASER001 </dev/null &
qemu=$!
tail -n +1 -f --pid=$qemu "$share/log"
wait $qemu || true
[[ -s $share/exit_code ]] || {
  echo "the guest gave no exit code; the end of its console:" >&2
  tail -15 "$FOLDER/console" >&2
  exit 125
}
exit "$(cat "$share/exit_code")"
