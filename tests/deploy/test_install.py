"""`deploy/install.sh` below a folder of its own: a second time changes nothing, an upgrade keeps what is yours,
and after an uninstall everything is as it was."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDERS_OF_A_HOST = ["etc", "opt", "usr/local/bin", "usr/local/lib", "var/lib", "var/cache", "run"]


class Host:
    """A folder that looks like a host's root, and the repository that is installed into it."""

    def __init__(self, root: Path, repository: Path = ROOT):
        self.root, self.repository = root, repository
        for name in FOLDERS_OF_A_HOST:
            (root / name).mkdir(parents=True)

    def run(self, *arguments: str) -> subprocess.CompletedProcess:
        environment = {**os.environ, "DESTDIR": str(self.root)}
        script = self.repository / "deploy" / "install.sh"
        return subprocess.run(
            [script, *arguments], env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True
        )

    def does(self, *arguments: str) -> str:
        done = self.run(*arguments)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def content(self) -> dict[str, tuple]:
        """Return everything below the root: kind and mode, time of change, target or bytes."""
        found = {}
        for path in sorted(self.root.rglob("*")):
            state = path.lstat()
            held = os.readlink(path) if path.is_symlink() else path.read_bytes() if path.is_file() else b""
            found[str(path.relative_to(self.root))] = (oct(state.st_mode), state.st_mtime_ns * (held != b""), held)
        return found


@pytest.fixture
def host(tmp_path):
    return Host(tmp_path / "host")


@pytest.fixture
def later_repository(tmp_path):
    """A copy of this repository with a program that differs, and a unit that differs."""
    copy = tmp_path / "later"
    for name in ["stagectl", "drivers", "sim_backend", "profiles", "docs", "deploy"]:
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ["pyproject.toml", "README.md", "CHANGELOG.md", "LICENSE"]:
        shutil.copy2(ROOT / name, copy / name)
    (copy / "stagectl" / "added.py").write_text('"""New."""\n')
    unit = copy / "deploy" / "stagectl.service"
    unit.write_text(unit.read_text().replace("WatchdogSec=10", "WatchdogSec=9"))
    return copy


def test_a_second_time_changes_nothing(host):
    host.does("install")
    first = host.content()
    host.does("install")
    assert host.content() == first
    host.does("upgrade")
    assert host.content() == first


def test_what_is_installed_is_the_program_without_leftovers(tmp_path, later_repository):
    host = Host(tmp_path / "host", later_repository)
    leftover = later_repository / "stagectl" / "__pycache__" / "tick.cpython-311.pyc"
    leftover.parent.mkdir()
    leftover.touch()
    host.does("install")
    current = host.root / "opt" / "stagectl" / "current"
    for part in ("stagectl", "drivers", "sim_backend", "profiles"):
        names = {path.relative_to(later_repository) for path in (later_repository / part).rglob("*") if path.is_file()}
        installed = {path.relative_to(current) for path in (current / part).rglob("*") if path.is_file()}
        assert installed == {name for name in names if "__pycache__" not in name.parts}
    assert not list(current.rglob("__pycache__"))
    assert os.readlink(host.root / "usr/local/bin/stagectl") == "/opt/stagectl/current/venv/bin/stagectl"
    unit = (host.root / "usr/local/lib/systemd/system/stagectl.service").read_text()
    for line in unit.splitlines():
        if line.startswith("ExecStopPost="):
            script = host.root / line.split()[0].removeprefix("ExecStopPost=/")
            assert os.access(script, os.X_OK)
            break
    else:
        pytest.fail("the unit has no ExecStopPost")


def test_an_upgrade_keeps_profiles_runs_and_settings(host, later_repository):
    host.does("install")
    before = os.readlink(host.root / "opt/stagectl/current")
    profile = host.root / "etc/stagectl/my-stage.toml"
    profile.write_text("name = 'my-stage'\n")
    settings = host.root / "etc/stagectl/stagectl.env"
    settings.write_text("STAGECTL_SERVE=my-stage\n")
    run = host.root / "var/lib/stagectl/runs/20260101-120000-service-arm"
    run.mkdir()
    (run / "samples.arrow").write_bytes(bytes(1000))
    kept = {
        name: held
        for name, held in host.content().items()
        if name.startswith(("etc/stagectl/my-stage", "var/lib/stagectl/runs"))
    }
    assert kept

    later = Host.__new__(Host)
    later.root, later.repository = host.root, later_repository
    later.does("upgrade")
    after = os.readlink(host.root / "opt/stagectl/current")
    assert after != before
    assert not (host.root / "opt/stagectl" / before).exists()
    assert (host.root / "opt/stagectl/current/stagectl/added.py").exists()
    assert "WatchdogSec=9" in (host.root / "usr/local/lib/systemd/system/stagectl.service").read_text()
    assert settings.read_text() == "STAGECTL_SERVE=my-stage\n"
    content = host.content()
    assert {name: content[name] for name in kept} == kept


def test_an_upgrade_of_nothing_is_refused(host):
    before = host.content()
    refused = host.run("upgrade")
    assert refused.returncode == 1
    assert "use install" in refused.stderr
    assert host.content() == before


def test_a_release_that_was_left_unfinished_is_made_anew(host):
    host.does("install")
    whole = host.content()
    release = host.root / "opt/stagectl" / os.readlink(host.root / "opt/stagectl/current")
    (release / ".unfinished").touch()
    (release / "stagectl" / "tick.py").unlink()
    host.does("install")
    content = host.content()
    assert content.keys() == whole.keys()


def test_an_install_that_was_interrupted_at_its_switch_leaves_the_next_one_right(host, later_repository):
    """The link that was to be moved was still there, and the next one was made inside the release that it led to."""
    host.does("install")
    releases = host.root / "opt/stagectl"
    before = os.readlink(releases / "current")
    (releases / ".current").symlink_to(before)
    later = Host.__new__(Host)
    later.root, later.repository = host.root, later_repository
    later.does("upgrade")
    assert os.readlink(releases / "current") != before
    assert {path.name for path in releases.iterdir()} == {"current", os.readlink(releases / "current")}
    assert (releases / "current/stagectl/added.py").exists()


def test_an_uninstall_leaves_nothing(host):
    before = host.content()
    host.does("install")
    (host.root / "etc/stagectl/my-stage.toml").write_text("name = 'my-stage'\n")
    (host.root / "var/lib/stagectl/runs/one").mkdir()
    dropin = host.root / "etc/systemd/system/stagectl.service.d/override.conf"
    dropin.parent.mkdir(parents=True)
    dropin.write_text("[Service]\nCPUAffinity=0 3\n")
    host.does("uninstall", "--yes")
    after = host.content()
    assert {name for name in after if name not in before} == {"etc/systemd", "etc/systemd/system"}  # the test's own
    assert {name: after[name] for name in before} == before
    host.does("uninstall")  # of nothing: no error


def test_an_uninstall_leaves_what_others_have_put_beside_it(host):
    host.does("install")
    others = host.root / "usr/local/lib/udev/rules.d/10-others.rules"
    others.write_text("# theirs\n")
    host.does("uninstall")
    assert others.read_text() == "# theirs\n"
    assert not (others.parent / "65-stagectl.rules").exists()


def test_an_uninstall_can_keep_profiles_and_runs(host, tmp_path):
    host.does("install")
    (host.root / "etc/stagectl/my-stage.toml").write_text("name = 'my-stage'\n")
    run = host.root / "var/lib/stagectl/runs/one"
    run.mkdir()
    (run / "events.jsonl").write_text("{}\n")
    host.does("uninstall", "--keep", str(tmp_path / "kept"))
    kept = {str(path.relative_to(tmp_path / "kept")) for path in (tmp_path / "kept").rglob("*") if path.is_file()}
    assert {"etc-stagectl/my-stage.toml", "lib-stagectl/runs/one/events.jsonl"} <= kept
    assert not (host.root / "var/lib/stagectl").exists()


@pytest.mark.parametrize(
    "place", ["opt/stagectl/kept", "var/cache/stagectl", "etc/stagectl/../stagectl/kept", "link/kept"]
)
def test_what_is_to_be_kept_is_not_put_where_an_uninstall_removes_it(host, place):
    host.does("install")
    (host.root / "var/lib/stagectl/runs/one").mkdir()
    (host.root / "link").symlink_to(host.root / "var/lib/stagectl")
    before = host.content()
    refused = host.run("uninstall", "--keep", str(host.root / place))
    assert refused.returncode == 1
    assert "give a folder outside it" in refused.stderr
    assert host.content() == before


@pytest.mark.parametrize("kept", ["etc/stagectl/my-stage.toml", "var/lib/stagectl/runs/one"])
def test_an_uninstall_that_can_ask_nobody_deletes_no_run_and_no_profile(host, kept):
    host.does("install")
    (host.root / kept).mkdir()
    before = host.content()
    refused = host.run("uninstall")
    assert refused.returncode == 1
    assert "no terminal to ask" in refused.stderr
    assert "--keep FOLDER" in refused.stderr
    assert host.content() == before


@pytest.mark.parametrize("arguments", [[], ["remove"], ["install", "--wheel", "x"], ["install", "--wheels"]])
def test_what_is_not_understood_changes_nothing(host, arguments):
    before = host.content()
    refused = host.run(*arguments)
    assert refused.returncode != 0
    assert refused.stderr
    assert host.content() == before


def test_shellcheck_finds_nothing():
    checker = shutil.which("shellcheck")
    if checker is None:
        pytest.skip("this host has no shellcheck")
    scripts = sorted((ROOT / "deploy").rglob("*.sh"))
    assert scripts
    found = subprocess.run([checker, *scripts], capture_output=True, text=True)
    assert found.returncode == 0, found.stdout
