#!/usr/bin/env bash
# Puts stagectl on a stage PC, and takes it off again. Debian 12 or alike: systemd, Python 3.11 with venv.
#
#   deploy/install.sh install   [--wheels FOLDER]   make everything that is not there yet; starts nothing
#   deploy/install.sh upgrade   [--wheels FOLDER]   this version in place of the installed one; profiles and runs stay
#   deploy/install.sh uninstall [--keep FOLDER] [--yes]   leave nothing; profiles and runs go to FOLDER where one is given
#
#   --wheels FOLDER   install the Python packages from there: a stage PC has no internet
#   --yes             don't ask before profiles and runs are deleted; needed where there is no terminal to ask on
#   DESTDIR           install below this folder instead of /: files only, no users, no Python environment, no systemd
#   PYTHON            the interpreter of the installation (default: python3)
#
# Each version lies in a folder of its own below /opt/stagectl, and `current` leads to one of them: an installation that
# fails half-way leaves the one before it as it was.
set -euo pipefail
umask 022

SOURCE=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
DESTDIR=${DESTDIR:-}
DESTDIR=${DESTDIR%/}
PYTHON=${PYTHON:-python3}
PROGRAM=/opt/stagectl
PARTS=(stagectl drivers sim_backend profiles docs deploy pyproject.toml README.md CHANGELOG.md LICENSE)
STATES_AT_REST="off idle fault"

# What goes where, beside the program. /usr/local/lib is ours, /etc is yours.
FILES=(
  "stagectl.service /usr/local/lib/systemd/system/stagectl.service"
  "stagectl.rules /usr/local/lib/udev/rules.d/65-stagectl.rules"
  "stagectl.sysusers /usr/local/lib/sysusers.d/stagectl.conf"
  "stagectl.tmpfiles /usr/local/lib/tmpfiles.d/stagectl.conf"
  "stagectl.modules /usr/local/lib/modules-load.d/stagectl.conf"
)
# Folders that are removed when nothing of anybody else is in them, deepest first.
SHARED_FOLDERS=(
  /usr/local/lib/systemd/system /usr/local/lib/systemd /usr/local/lib/udev/rules.d /usr/local/lib/udev
  /usr/local/lib/sysusers.d /usr/local/lib/tmpfiles.d /usr/local/lib/modules-load.d
)
DATA_FOLDERS=(/etc/stagectl /var/lib/stagectl /var/cache/stagectl)
DROP_INS=/etc/systemd/system/stagectl.service.d

say() { printf '%s\n' "$*"; }
refuse() {
  printf 'install.sh: %s\n' "$*" >&2
  exit 1
}
usage() {
  sed -n '4,12s/^# \{0,3\}//p' "${BASH_SOURCE[0]}"
  exit "$1"
}

staged() { [[ -n $DESTDIR ]]; }
has_systemd() { ! staged && [[ -d /run/systemd/system ]]; }

# The version and its content, so that another state of the same version is another release.
release_name() {
  local version content
  version=$(sed -n 's/^version = "\(.*\)"$/\1/p' "$SOURCE/pyproject.toml" | head -1)
  content=$(cd "$SOURCE" && find "${PARTS[@]}" -type f ! -path '*/__pycache__/*' ! -name '*.pyc' -print0 |
    LC_ALL=C sort -z | xargs -0 sha256sum | sha256sum | cut -c1-12)
  [[ -n $version && -n $content ]] || refuse "$SOURCE: no sources of stagectl; start this file from its repository"
  printf '%s-%s' "$version" "$content"
}

check_host() {
  staged && return
  [[ $EUID -eq 0 ]] || refuse "only root may install below /; use sudo, or set DESTDIR to a folder of yours"
  "$PYTHON" -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null ||
    refuse "$PYTHON: Python 3.11 or newer with venv is needed (Debian: apt install python3 python3-venv; else PYTHON=...)"
}

unit_state() { systemctl show -P ActiveState stagectl.service; }
service_runs() { has_systemd && [[ $(unit_state) != inactive && $(unit_state) != failed ]]; }

# The installed service is only stopped where nothing has power. One that is not up yet answers nobody and powers nothing.
check_at_rest() {
  has_systemd && [[ $(unit_state) == active ]] || return 0
  local state
  state=$("$PROGRAM/current/venv/bin/stagectl" status --json 2>/dev/null |
    "$PYTHON" -c 'import json, sys; print(json.load(sys.stdin)["state"])' 2>/dev/null) || true
  [[ " $STATES_AT_REST " == *" ${state:-unknown} "* ]] ||
    refuse "the stage is ${state:-in a state that nobody tells}: bring it to rest first (stagectl stop, or systemctl stop stagectl)"
}

make_release() { # NAME WHEELS
  local folder=$DESTDIR$PROGRAM/$1 unfinished=$DESTDIR$PROGRAM/$1/.unfinished
  if [[ -d $folder && ! -e $unfinished ]]; then
    say "release $1 is there already"
    return
  fi
  rm -rf "$folder"
  mkdir -p "$folder"
  touch "$unfinished"
  tar -C "$SOURCE" --exclude=__pycache__ --exclude='*.pyc' --exclude='*.egg-info' --owner=0 --group=0 -c "${PARTS[@]}" |
    tar -C "$folder" --no-same-owner -x
  chmod -R go-w,a+rX "$folder"
  if staged; then
    say "DESTDIR: no Python environment; make it where it will stand"
  else
    say "installing Python packages (about 1 GB of disk, a minute or two)"
    local from=()
    [[ -z $2 ]] || from=(--no-index --find-links "$2")
    "$PYTHON" -m venv "$folder/venv"
    "$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-input --no-cache-dir "${from[@]}" \
      --editable "$folder" || refuse "the packages could not be installed; the version before, if any, is untouched"
    "$folder/venv/bin/python" -m compileall -q "$folder/stagectl" "$folder/drivers" "$folder/sim_backend"
  fi
  rm "$unfinished"
  say "release $1 made"
}

put() { # FROM TO: only where it differs, so that a second time changes nothing
  cmp --silent "$1" "$DESTDIR$2" || install -D -m 0644 "$1" "$DESTDIR$2"
}

switch_to() { # RELEASE
  local program=$DESTDIR$PROGRAM
  if [[ $(readlink "$program/current" 2>/dev/null) != "$1" ]]; then
    ln -sfn "$1" "$program/.current" # one that an interrupted install left is replaced, and not entered
    mv -T "$program/.current" "$program/current"
    rm -rf "$DESTDIR"/var/cache/stagectl/* # compiled from other sources
  fi
  mkdir -p "$DESTDIR/usr/local/bin"
  local command=$DESTDIR/usr/local/bin/stagectl target=$PROGRAM/current/venv/bin/stagectl
  [[ $(readlink "$command" 2>/dev/null) == "$target" ]] || ln -sf "$target" "$command"
}

remove_other_releases() { # RELEASE
  find "$DESTDIR$PROGRAM" -mindepth 1 -maxdepth 1 ! -name "$1" ! -name current -exec rm -rf {} +
}

put_files() { # SOURCE
  local entry from to
  for entry in "${FILES[@]}"; do
    read -r from to <<<"$entry"
    put "$1/deploy/$from" "$to"
  done
  [[ -e $DESTDIR/etc/stagectl/stagectl.env ]] || put "$1/deploy/stagectl.env" /etc/stagectl/stagectl.env
  if staged; then
    mkdir -p "$DESTDIR/var/lib/stagectl/runs" "$DESTDIR/var/cache/stagectl"
    return
  fi
  systemd-sysusers stagectl.conf
  systemd-tmpfiles --create stagectl.conf
  has_systemd || return 0
  systemctl daemon-reload
  systemctl restart systemd-modules-load.service || say "not every kernel module is there: journalctl -u systemd-modules-load"
  udevadm control --reload
  udevadm trigger --action=add --subsystem-match=tty --subsystem-match=usb-serial
}

# Whatever fails between the service's stop and its start: a stage PC is left with the release that ran.
go_back() { # RELEASE
  local failed=$?
  trap - EXIT
  say "the new release could not be put in place, or does not start (journalctl -u stagectl): back to $1" >&2
  { switch_to "$1" && put_files "$PROGRAM/$1" && systemctl reset-failed stagectl.service &&
    systemctl restart stagectl.service && say "the service runs again, as it was" >&2; } ||
    say "the service is stopped: systemctl status stagectl" >&2
  exit $((failed == 0 ? 1 : failed))
}

install_release() { # install | upgrade, WHEELS
  local release before was_active=
  check_host
  if [[ $1 == upgrade && ! -L $DESTDIR$PROGRAM/current ]]; then
    refuse "nothing is installed in $DESTDIR$PROGRAM; use install"
  fi
  release=$(release_name)
  check_at_rest
  make_release "$release" "$2"
  before=$(readlink "$DESTDIR$PROGRAM/current") || true
  if service_runs && [[ $before != "$release" ]]; then
    check_at_rest # making the release took minutes
    was_active=yes
    say "stopping the service"
    # shellcheck disable=SC2064 # the release that runs now
    trap "go_back '$before'" EXIT
    systemctl stop stagectl.service
  fi
  switch_to "$release"
  put_files "$SOURCE"
  if [[ -n $was_active ]]; then
    systemctl start stagectl.service
    trap - EXIT
    say "the service runs again"
  fi
  remove_other_releases "$release"
  say "stagectl $release is installed"
  [[ $1 == upgrade ]] || say "next: /etc/stagectl/stagectl.env, then systemctl enable --now stagectl ($PROGRAM/current/docs/operations.md)"
}

count_of() { # FOLDER, find's tests: how many
  { find "$DESTDIR$1" -mindepth 1 -maxdepth 1 "${@:2}" 2>/dev/null || true; } | wc -l
}

check_outlasts() { # KEEP: what is copied there is still there after the uninstall
  local folder doomed
  for folder in "$PROGRAM" "${DATA_FOLDERS[@]}" "$DROP_INS"; do
    doomed=$(realpath -m "$DESTDIR$folder")
    [[ $1/ != "$doomed"/* ]] || refuse "--keep $1: uninstall removes $doomed; give a folder outside it; nothing was done"
  done
}

uninstall() { # KEEP YES
  local keep=$1 runs_count profiles_count answer entry folder
  staged || [[ $EUID -eq 0 ]] || refuse "only root may uninstall below /; use sudo"
  [[ -z $keep ]] || check_outlasts "$keep"
  runs_count=$(count_of /var/lib/stagectl/runs -type d)
  profiles_count=$(count_of /etc/stagectl -name '*.toml')
  if [[ -z $keep && -z $2 && $((runs_count + profiles_count)) -gt 0 ]]; then
    [[ -t 0 ]] || refuse "$runs_count runs and $profiles_count profiles would be deleted, and there is no terminal to ask" \
      "on: --keep FOLDER keeps them, --yes deletes them; nothing was done"
    read -r -p "delete $runs_count runs and $profiles_count profiles? --keep FOLDER would keep them [yes/no] " answer
    [[ $answer == yes ]] || refuse "nothing was done"
  fi
  check_at_rest
  if has_systemd && [[ $(systemctl show -P LoadState stagectl.service) == loaded ]]; then
    systemctl --quiet disable --now stagectl.service
    systemctl --quiet reset-failed stagectl.service 2>/dev/null || true
  fi
  if [[ -n $keep ]]; then
    mkdir -p "$keep"
    for folder in /etc/stagectl /var/lib/stagectl; do
      [[ ! -d $DESTDIR$folder ]] || cp -a "$DESTDIR$folder" "$keep/$(basename "$(dirname "$folder")")-stagectl"
    done
    say "profiles and runs are in $keep"
  fi
  for entry in "${FILES[@]}"; do rm -f "$DESTDIR${entry#* }"; done
  rm -rf "$DESTDIR$PROGRAM" "$DESTDIR/usr/local/bin/stagectl" "$DESTDIR$DROP_INS"
  for folder in "${DATA_FOLDERS[@]}"; do rm -rf "$DESTDIR${folder:?}"; done
  for folder in "${SHARED_FOLDERS[@]}"; do rmdir "$DESTDIR$folder" 2>/dev/null || true; done
  if ! staged; then
    if getent passwd stagectl >/dev/null; then
      find /dev/shm -maxdepth 1 -user stagectl -name 'stagectl-*' -delete
      userdel stagectl
    fi
    getent group stagectl >/dev/null && groupdel stagectl
  fi
  if has_systemd; then
    systemctl daemon-reload
    udevadm control --reload
    udevadm trigger --action=add --subsystem-match=tty # the names that adapters have by our rules
  fi
  say "stagectl is uninstalled; $runs_count runs and $profiles_count profiles were ${keep:+copied to $keep and }deleted"
}

action=${1:-}
[[ $# -eq 0 ]] || shift
wheels='' keep='' yes=''
while [[ $# -gt 0 ]]; do
  case $1 in
    --wheels | --keep) [[ $# -gt 1 ]] || refuse "$1 needs a folder" ;;&
    --wheels) wheels=$(realpath -e "$2") || refuse "--wheels $2: there is no such folder" ; shift 2 ;;
    --keep) keep=$(realpath -m "$2") ; shift 2 ;;
    --yes) yes=yes ; shift ;;
    *) refuse "$1: there is no such option; install.sh --help shows all" ;;
  esac
done
case $action in
  install | upgrade) install_release "$action" "$wheels" ;;
  uninstall) uninstall "$keep" "$yes" ;;
  -h | --help) usage 0 ;;
  *) usage 2 >&2 ;;
esac
