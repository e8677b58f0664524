"""The rooms of the package: who may import whom, and what the README promises."""

import ast
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "countersteer"

EVERYONE = {
    "errors", "text", "progress", "signals", "random_streams", "compiling", "kept_programs",
    "cache", "clock", "writing", "reading",
}  # fmt: skip
MAY_IMPORT = {
    "car": set(),
    "course": {"car"},
    "world": {"car", "course"},
    "sensing": {"car", "course", "world"},  # sensors look at the world's motion
    "link": {"car"},
    "estimation": {"car", "course", "world", "sensing"},
    "drivers": {"car", "course", "estimation", "world"},  # the motor's law, for feed-forward
    "planning": {"car", "course", "world", "drivers"},
    "pilot": {"car", "course", "link", "estimation", "drivers"},  # and not the world
    "simulator": {
        "car", "course", "world", "sensing", "link", "drivers", "pilot",
        "estimation",  # the estimate is in the record
    },
    "task": {"car", "course"},
    "runs": {"car", "course"},
    "tuning": {"car", "world", "sensing", "runs"},
    "recorded_drive": {  # a drive into a run's folder
        "car", "course", "world", "sensing", "link", "drivers", "pilot", "simulator", "task",
        "runs",
    },
    "judge_run": {"course", "task", "runs", "tuning"},  # the judge of a folder
    "batch": {
        "car", "course", "world", "sensing", "link", "pilot", "simulator", "task",
        "estimation", "drivers",  # what open drives are told of the truth
    },
    "envs": {
        "car", "course", "world", "sensing", "link", "simulator", "task", "batch",
        "drivers",  # what a network is told
    },
    "learning": {
        "car", "course", "pilot", "task", "runs", "batch", "envs", "link",
        "drivers",  # what is learned is a driver's numbers
        "experiments",  # from which it learns
        "viewing",  # pictures have one style
        "planning",  # where the walls are
    },
    "experiments": {
        "car", "course", "world", "link", "estimation", "pilot", "simulator", "task", "runs",
        "batch", "tuning", "drivers",
        "planning",  # what the planner and the optimum can do
        "viewing",  # pictures have one style
    },
    "bench": {
        "car", "course", "world", "pilot", "simulator", "batch",
        "drivers",  # it times a drive, so it needs one that drives
    },
    "viewing": {
        "car", "runs", "task", "world",  # a car is drawn to its size, with its forces
        "batch", "tuning",  # what came of trials and of fits
    },
    "cockpit": {  # a person in place of a driver, and the report's viewer live
        "car", "course", "world", "sensing", "link", "estimation", "drivers", "pilot", "simulator",
        "task", "runs", "recorded_drive", "viewing",
    },
    "cli": None,
    "api": None,  # what `import countersteer` gives
    "__init__": None,
    "__main__": {"cli"},
}  # fmt: skip


def room(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported(path: Path) -> set[str]:
    rooms = set()
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            parts = name.split(".")
            if parts[0] == "countersteer" and len(parts) > 1:
                rooms.add(parts[1])
    return rooms


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda p: p.stem)
def test_imports_run_one_way(path):
    here = room(path)
    if here in EVERYONE:
        assert not imported(path) - EVERYONE
        return
    allowed = MAY_IMPORT[here]
    if allowed is not None:
        wrong = imported(path) - allowed - EVERYONE - {here, "__version__"}
        assert not wrong, f"{here} may not import {wrong}"


def test_nothing_that_is_read_is_executed():
    for path in PACKAGE.rglob("*.py"):
        names = {
            node.func.id
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        }
        assert not names & {"eval", "exec", "compile", "__import__"}, path
        assert "pickle" not in path.read_text(), path


def test_every_command_of_the_readme_is_a_command():
    from countersteer.cli import parser

    text = (ROOT / "README.md").read_text()
    commands = re.findall(r"`countersteer ([^`]+)`", text)
    assert len(commands) >= 5
    for command in commands:
        parser().parse_args(command.split())


def test_what_the_readme_links_to_is_there():
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", (ROOT / "README.md").read_text()):
        assert (ROOT / target).exists(), target


def test_what_the_map_names_is_there():
    text = (ROOT / "docs" / "map.md").read_text()
    names = re.findall(r"`([\w/]+(?:/|\.py|\.html))`", text)
    assert len(names) > 40
    for name in names:
        assert (PACKAGE / name).exists() or (ROOT / name).exists(), name
    rooms = {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").exists()}
    assert not {room for room in rooms if f"`{room}/" not in text}, "a room that the map lacks"


def test_no_function_is_over_a_hundred_lines():
    for path in [*PACKAGE.rglob("*.py"), *(ROOT / "studies").glob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                length = node.end_lineno - node.lineno + 1
                assert length <= 100, f"{path.name}: {node.name} has {length} lines"


def test_pins_carry_names_and_versions_only():
    for line in (ROOT / "constraints.txt").read_text().splitlines():
        assert re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.]+", line), line


def test_every_exception_to_the_linter_says_why():
    text = (ROOT / "pyproject.toml").read_text()
    tomllib.loads(text)
    for line in text.splitlines():
        if re.match(r'\s*"[A-Z]+[0-9]*",', line):
            assert "#" in line, line
    for path in [*PACKAGE.rglob("*.py"), *(ROOT / "tests").glob("*.py")]:
        for line in path.read_text().splitlines():
            if re.search(r"# (noqa|type: ignore)", line) and "re.search" not in line:
                assert re.search(r"(noqa: [A-Z0-9, ]+|type: ignore\[[a-z-]+\])  # \S", line), line
