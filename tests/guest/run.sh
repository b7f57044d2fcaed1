#!/usr/bin/env bash
# run.sh: prove stagectl on a stage PC in a box. Boots three Debian guests with a PREEMPT_RT kernel, systemd, a CAN interface
# and a serial line, and runs checks.py in them; prints what it says. Exit code: that of the checks, 125 where there was none.
# Root, Debian or alike. Installs what it needs with apt; keeps the image in $XDG_CACHE_HOME/stagectl-guest.
set -euo pipefail
HERE=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
FOLDER=${XDG_CACHE_HOME:-$HOME/.cache}/stagectl-guest
LIMIT_S=${GUEST_LIMIT_S:-2700} # of each machine: all three take 12 to 30 minutes on two processors, by the host

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

# A machine's clock: its processor's where it is virtualised, the host's where it is emulated; there those that move have
# one that goes on with the instructions they have carried out, two nanoseconds each. So their servo keeps its 100 Hz on a
# host of any speed and load, and the test takes longer. That needs one CPU; `installation` shows what two are for.
# Without erms: emulated, what the kernel and libc copy byte by byte is a fifth of the work.
two_cpus=(-accel "tcg,thread=multi" -smp 2 -cpu "max,-erms")
own_clock=(-accel "tcg,thread=single" -icount "shift=1,sleep=on" -smp 1 -cpu "max,-erms")
if [[ -w /dev/kvm ]] && grep -qsE '^flags.* (svm|vmx)( |$)' /proc/cpuinfo; then
  two_cpus=(-accel kvm -smp 2 -cpu max)
  own_clock=("${two_cpus[@]}")
fi

# The interferometer's line: a port of the virtual machine writes, an FTDI adapter reads; they are one wire. The port hands
# over a line as one; a second UART would do so byte by byte, and each byte wakes the servo up.
boot() { # NAME NICENESS OPTIONS
  local name=$1 niceness=$2 folder=$FOLDER/$1 qemu
  shift 2
  rm -rf "$folder"
  mkdir -p "$folder/share"
  cp "$HERE"/*.py "$HERE"/*.toml "$folder/share/"
  echo "$name" >"$folder/share/machine"
  printf '%s\n' "${GUEST_CHECKS:-}" >"$folder/share/only"
  : >"$folder/share/log"
  timeout --kill-after=20 "$LIMIT_S" nice -n "$niceness" qemu-system-x86_64 "$@" -m 3072 -display none -no-reboot -nic none -monitor none \
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
trap 'cat "$FOLDER"/{installation,homing,motion}/pid 2>/dev/null | xargs -r kill 2>/dev/null || true' EXIT
# Two at a time, the last as soon as one of the others has ended: beside both, `installation`, whose clock is the host's,
# once saw no line of its interferometer within 5 s for 17 minutes. `motion` goes first: its clock goes on while a line
# waits for the host's processor.
code=0 running=0
await_one() {
  wait -n || code=$?
  running=$((running - 1))
}
read -ra machines <<<"${GUEST_MACHINES:-motion homing installation}"
for machine in "${machines[@]}"; do
  while ((running >= 2)); do await_one; done
  case $machine in
  installation) boot installation 10 "${two_cpus[@]}" & ;;
  homing) boot homing 10 "${own_clock[@]}" & ;;
  motion) boot motion 0 "${own_clock[@]}" & ;;
  esac
  running=$((running + 1))
done
while ((running > 0)); do await_one; done
# Once more: of a long output often only the end is kept.
for machine in "${machines[@]}"; do grep FAILED "$FOLDER/$machine/share/log" | sed "s/^/$machine  /" || true; done
exit $code
