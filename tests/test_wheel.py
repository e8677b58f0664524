"""The wheel, for where there is no make: it holds all that the sources hold, and it runs."""

import importlib.metadata
import importlib.util
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
OLDEST = 77  # of setuptools, as in pyproject.toml

COMMAND = (
    "from importlib.metadata import entry_points\n"
    "(command,) = entry_points(group='console_scripts', name='countersteer')\n"
    "command.load()()"
)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel of the sources, unpacked; built offline, outside of the sources."""
    if not importlib.util.find_spec("pip") or not importlib.util.find_spec("setuptools"):
        pytest.skip("no pip and setuptools to build with")
    if int(importlib.metadata.version("setuptools").split(".")[0]) < OLDEST:
        pytest.skip(f"setuptools is older than {OLDEST}")
    folder = tmp_path_factory.mktemp("wheel")
    sources = folder / "sources"
    shutil.copytree(
        ROOT / "src", sources / "src", ignore=shutil.ignore_patterns("__pycache__", "*.egg-info")
    )
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, sources)
    build = ["wheel", "--no-build-isolation", "--no-deps", "--no-index", "--wheel-dir", "."]
    done = subprocess.run(
        [sys.executable, "-m", "pip", *build, str(sources)],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    (made,) = folder.glob("*.whl")
    zipfile.ZipFile(made).extractall(folder / "unpacked")
    return folder / "unpacked"


def run(wheel: Path, folder: Path, *arguments: str) -> str:
    """What the wheel's command prints in an empty folder."""
    done = subprocess.run(
        [sys.executable, "-c", COMMAND, *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(wheel)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert not list(folder.iterdir())
    return done.stdout


def test_every_file_of_the_package_is_in_the_wheel(wheel):
    def files(folder: Path) -> dict[str, bytes]:
        found = (p for p in folder.rglob("*") if p.is_file() and "__pycache__" not in p.parts)
        return {str(p.relative_to(folder)): p.read_bytes() for p in found}

    sources = files(ROOT / "src" / "countersteer")
    assert {Path(name).suffix for name in sources} >= {".py", ".toml", ".html"}
    assert files(wheel / "countersteer") == sources


def test_the_readme_is_the_long_description(wheel):
    (about,) = wheel.glob("*.dist-info/METADATA")
    text = about.read_text(encoding="utf-8")
    assert text.endswith((ROOT / "README.md").read_text(encoding="utf-8"))
    assert "Description-Content-Type: text/markdown" in text


def test_the_command_of_the_wheel_answers(wheel, tmp_path):
    assert "drive" in run(wheel, tmp_path, "--help")
    where = subprocess.run(
        [sys.executable, "-c", "import countersteer; print(countersteer.__file__)"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(wheel)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert where.stdout.startswith(str(wheel))
    assert "box" in run(wheel, tmp_path, "list", "courses")
    assert "rx7" in run(wheel, tmp_path, "list", "cars")
