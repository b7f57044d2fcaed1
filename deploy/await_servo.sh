#!/bin/sh
# await_servo.sh SECONDS [PROCS_FILE]: after the supervisor is gone, wait for what it left in the unit's control group.
# A servo that lost its supervisor brings the stage to rest, takes the power away, saves its rows, and ends. One that
# hangs would keep bus and port from the next start for ever: after SECONDS it is killed, and the drives stop the stage.
set -u
limit_s=$1
procs=${2:-/sys/fs/cgroup$(sed -n 's/^0:://p' /proc/self/cgroup)/cgroup.procs}
left=

look() { # builtins only: a child of this shell would stand in the list, too
  left=
  while read -r pid; do
    if [ "$pid" != $$ ] && kill -0 "$pid" 2>/dev/null; then left="$left $pid"; fi
  done <"$procs"
}

if ! [ -r "$procs" ]; then
  echo "$procs: can't be read, so nobody waits for the servo" >&2
  exit 0
fi
waited_tenths=0
look
while [ -n "$left" ] && [ "$waited_tenths" -lt $((limit_s * 10)) ]; do
  sleep 0.1
  waited_tenths=$((waited_tenths + 1))
  look
done
if [ -n "$left" ]; then
  echo "still there after $limit_s s, killed:$left" >&2
  # shellcheck disable=SC2086 # several process ids
  kill -KILL $left 2>/dev/null
fi
exit 0
