"""What is installed is what is here: every package is listed, and the page's assets and the mark of types go along."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def test_every_package_is_installed():
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    here = {
        ".".join(path.parent.relative_to(ROOT).parts)
        for name in ("stagectl", "drivers", "sim_backend")
        for path in (ROOT / name).rglob("__init__.py")
    }
    assert set(listed["packages"]) == here
    for package, patterns in listed["package-data"].items():
        folder = ROOT.joinpath(*package.split("."))
        assert all(any(one.is_file() for one in folder.glob(pattern.replace("**", "**/*"))) for pattern in patterns)
    assert "py.typed" in listed["package-data"]["stagectl"]  # else nobody's type checker sees the client's types
