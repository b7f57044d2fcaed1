#!/usr/bin/env bash
# run.sh: prove stagectl on a stage PC in a box. Boots two Debian guests with a PREEMPT_RT kernel, systemd, a CAN interface
# and a serial line, and runs checks.py in them; prints what it says. Exit code: that of the checks, 125 where there was none.
# Root, Debian or alike. Installs what it needs with apt; keeps the image in $XDG_CACHE_HOME/stagectl-guest.
set -euo pipefail
HERE=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
FOLDER=${XDG_CACHE_HOME:-$HOME/.cache}/stagectl-guest
LIMIT_S=${GUEST_LIMIT_S:-2700} # of each machine: `motion` takes 15 to 25 minutes on two processors, by the host

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

# A machine's clock: its processor's where it is virtualised, the host's where it is emulated; there `motion` has one that
# goes on with the instructions it has carried out, two nanoseconds each. So its servo keeps its 100 Hz on a host of any
# speed and load, and the test takes longer. That needs a machine of one CPU; `installation` shows what two are for.
# Without erms: emulated, what the kernel and libc copy byte by byte is a fifth of the work.
two_cpus=(-accel "tcg,thread=multi" -smp 2 -cpu "max,-erms")
own_clock=(-accel "tcg,thread=single" -icount "shift=1,sleep=on" -smp 1 -cpu "max,-erms")
if [[ -w /dev/kvm ]] && grep -qsE '^flags.* (svm|vmx)( |$)' /proc/cpuinfo; then
  two_cpus=(-accel kvm -smp 2 -cpu max)
  own_clock=("${two_cpus[@]}")
fi

# The interferometer's line: a port of the virtual machine writes, an FTDI adapter reads; they are one wire. The port hands
# over a line as one; a second UART would do so byte by byte, and each byte wakes the servo up.
boot() { # NAME OPTIONS
  local name=$1 folder=$FOLDER/$1 qemu
  shift
  rm -rf "$folder"
  mkdir -p "$folder/share"
  cp "$HERE"/*.py "$HERE"/*.toml "$folder/share/"
  echo "$name" >"$folder/share/machine"
  printf '%s\n' "${GUEST_CHECKS:-}" >"$folder/share/only"
  : >"$folder/share/log"
  timeout --kill-after=20 "$LIMIT_S" qemu-system-x86_64 "$@" -m 3072 -display none -no-reboot -nic none -monitor none \
    -pidfile "$folder/pid" -kernel "$FOLDER/vmlinuz" -initrd "$FOLDER/initrd" \
    -append "console=ttyS0 root=/dev/vda rw quiet loglevel=4 systemd.show_status=0 panic=-1 mitigations=off random.trust_cpu=on audit=0 apparmor=0 net.ifnames=0 tsc=reliable isolcpus=1" \
    -drive "file=$FOLDER/disk,if=virtio,format=raw,snapshot=on" \
    -virtfs "local,path=$folder/share,mount_tag=share,security_model=none,multidevs=remap" \
    -chardev "socket,id=a,path=$folder/wire,server=on,wait=off" -chardev "socket,id=b,path=$folder/wire" \
    -serial "file:$folder/console" -device virtio-serial-pci -device virtserialport,chardev=a,name=interferometer \
    -device qemu-xhci -device usb-serial,chardev=b,serial=LASER001 </dev/null &
  qemu=$!
  tail -n +1 -f --pid=$qemu "$folder/share/log" | sed -u "s/^/$name  /"
  wait $qemu || true
  [[ -s $folder/share/exit_code ]] || {
    echo "$name: the guest gave no exit code; the end of its console:" >&2
    tail -15 "$folder/console" >&2
    return 125
  }
  return "$(cat "$folder/share/exit_code")"
}

# Also where this is interrupted.
trap 'cat "$FOLDER"/{installation,motion}/pid 2>/dev/null | xargs -r kill 2>/dev/null || true' EXIT
# Side by side: neither keeps two CPUs of the host busy all the time.
code=0 running=()
for machine in ${GUEST_MACHINES:-installation motion}; do
  if [[ $machine == installation ]]; then boot installation "${two_cpus[@]}" & else boot motion "${own_clock[@]}" & fi
  running+=($!)
done
for machine in "${running[@]}"; do wait "$machine" || code=$?; done
grep --with-filename FAILED "$FOLDER"/*/share/log || true # once more, where the end of a long output is all that is kept
exit $code
