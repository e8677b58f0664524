"""Commands killed at random instants: `python -m studies.kills [--seed N] [--count N] [--verb V]`.

Each command writes over a result that was there before, and is killed with SIGKILL. Half of the
instants are drawn evenly over the time that the command takes undisturbed, the others over its last
fifth, where it writes its results. Then each result must be the one before or the new one, whole,
and all that is there must read. Of a drive that wrote a piece, `report` must make a page.
"""

import argparse
import contextlib
import filecmp
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from countersteer.car.files import load_car
from countersteer.cli.report import write_report
from countersteer.compiling import configure_jax
from countersteer.drivers.policy import load_policy
from countersteer.errors import InputError
from countersteer.runs.files import read_table
from countersteer.runs.run import read_run

COUNT = 100
LATE = 0.2  # part of the time, at its end, that half of the instants are drawn from
LONGEST = 300.0  # s, after which a command is hung


class Verb(NamedTuple):
    """A command, its result in the working folder, and its part of the kills."""

    arguments: str
    result: str  # a file, or a folder
    check: Callable[[Path], None]  # raises an exception if the result or a part of it is unreadable
    share: float
    exact: bool = True  # the new result is there as a whole or not at all, and always the same


class Kill(NamedTuple):
    """A kill and what came of it."""

    at: float  # part of the undisturbed time
    ended: bool  # before the kill
    replaced: bool  # the new result is there, whole
    lost: str  # what is wrong with the result before; empty: nothing
    unreadable: str


def check_drive(folder: Path) -> None:
    """A drive reads from its first piece on, and has a page then."""
    if rows(folder / "truth.csv") > 1:
        read_run(folder)
        write_report(folder)


def check_log(folder: Path) -> None:
    """An imported log reads."""
    read_run(folder)


def check_fit(file: Path) -> None:
    """A car reads, and its picture."""
    load_car(str(file))
    check_picture(file.with_suffix(".png"))


def check_policy(file: Path) -> None:
    """A policy reads."""
    load_policy(str(file))


def check_evaluation(folder: Path) -> None:
    """Each file reads that is there."""
    if (folder / "trials.csv").exists():
        read_table(folder / "trials.csv", ("seed",), text=("driver", "outcome"))
    if (folder / "evaluate.json").exists():
        json.loads((folder / "evaluate.json").read_text())
    if (folder / "evaluate.png").exists():
        check_picture(folder / "evaluate.png")


def check_picture(file: Path) -> None:
    """All frames of a picture read."""
    with Image.open(file) as picture:
        for frame in range(getattr(picture, "n_frames", 1)):
            picture.seek(frame)
            picture.load()


VERBS = {
    "drive": Verb("drive box --out drive", "drive", check_drive, 0.3, exact=False),
    # The page comes after the log, which is whole by then.
    "import": Verb("import eth log.npz --out logs", "logs/log", check_log, 0.2, exact=False),
    "tune": Verb(
        "tune step-0.3 step-0.6 --car jetracer --fit acceleration --out car/car.toml",
        "car/car.toml",
        check_fit,
        0.2,
    ),
    "learn": Verb(
        "learn turn box --generations 1 --candidates 4 --trials 1 --out policy/policy.toml",
        "policy/policy.toml",
        check_policy,
        0.1,
    ),
    "export": Verb(
        "export run --gif film/film.gif --force --fps 4 --width-px 160",
        "film/film.gif",
        check_picture,
        0.15,
    ),
    "evaluate": Verb(
        "evaluate box --trials 2 --out many", "many", check_evaluation, 0.05, exact=False
    ),
}


def rows(table: Path) -> int:
    """Whole lines of a file, which need not be there."""
    return table.read_bytes().count(b"\n") if table.exists() else 0


def start(arguments: str, where: Path) -> "subprocess.Popen[bytes]":
    """The command in a process of its own."""
    words = [sys.executable, "-m", "countersteer", *arguments.split()]
    return subprocess.Popen(
        words, cwd=where, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True
    )


def finish(arguments: str, where: Path) -> float:
    """Run the command to its end. Returns the time that it took (s)."""
    began = time.monotonic()
    process = start(arguments, where)
    _, errors = process.communicate(timeout=LONGEST)
    if process.returncode:
        raise SystemExit(f"{arguments}: exit status {process.returncode}: {errors.decode()}")
    return time.monotonic() - began


def prepare(verbs: Sequence[str], where: Path) -> None:
    """Make what the commands read."""
    (where / "film").mkdir()
    if "export" in verbs:
        finish("drive box --out run", where)
    if "import" in verbs:
        observed = np.zeros((3000, 12))
        observed[:, 0], observed[:, 3] = 0.0336 * np.arange(3000), 1.0
        np.savez(where / "log.npz", obs=observed, action=np.full((3000, 2), 0.1))
    if "tune" in verbs:
        finish("trials throttle-steps --out steps --levels 0.3,0.6", where)
        for level in ("0.3", "0.6"):
            commands = f"steps/throttle-{level}.csv"
            finish(f"replay {commands} --car jetracer --out step-{level}", where)


def same(one: Path, other: Path) -> bool:
    """Whether two files, or all files of two folders, hold the same."""
    if not (one.is_dir() and other.is_dir()):
        return one.is_file() and other.is_file() and filecmp.cmp(one, other, shallow=False)
    names = {path.name for path in (*one.iterdir(), *other.iterdir())}
    return all(same(one / name, other / name) for name in names)


def copy(source: Path, target: Path) -> None:
    """Copy a folder in place of another one."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(source, target)


def kills(name: str, count: int, rng: np.random.Generator, where: Path) -> list[Kill]:
    """Kill a command so many times, each over the result before."""
    verb = VERBS[name]
    finish(verb.arguments, where)  # compiles, and makes the result that is there before
    place = where / verb.result
    # What is written is in a folder of its own: the result itself, or the one around it.
    room, new = where / f"{name}-before", where / f"{name}-after"
    around = place if place.parent == where else place.parent
    copy(around, new)
    if place.is_file():
        # The same command gives the same file, so the one before is made another one.
        with place.open("ab") as file:
            file.write(b"\n# before\n" if place.suffix == ".toml" else b"before")
    else:
        (place / "before").write_text("before")
    copy(around, room)
    before, after = room / place.relative_to(around), new / place.relative_to(around)
    duration = min(finish(verb.arguments, where) for _ in range(2))
    found = []
    for _ in range(count):
        for other in where.glob(f"{around.name}.*"):  # moved aside
            shutil.rmtree(other)
        copy(room, around)
        at = float(rng.uniform(1 - LATE, 1) if rng.random() < 0.5 else rng.uniform())
        process = start(verb.arguments, where)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.communicate(timeout=at * duration)
        ended = process.returncode is not None
        process.send_signal(signal.SIGKILL)
        process.communicate()
        found.append(judged(verb, place, before, after, at, ended))
    return found


def judged(verb: Verb, place: Path, before: Path, after: Path, at: float, ended: bool) -> Kill:
    """What a kill has left of the result before, and of the new one."""
    aside = place.with_name(f"{place.name}.1")
    kept = [path for path in (place, aside) if path.exists() and same(path, before)]
    replaced = place.exists() and place not in kept
    lost = unreadable = ""
    if not kept and (before.is_dir() or not replaced):
        lost = "the result before is gone or changed"
    if verb.exact and replaced and not same(place, after):
        unreadable = f"{place.name}: is not whole"
    for path in (place, aside):
        if path.exists():
            try:
                verb.check(path)
            except (InputError, OSError, ValueError, EOFError) as error:
                unreadable = f"{path.name}: {error}"
    return Kill(at, ended, replaced, lost, unreadable)


def table(found: dict[str, list[Kill]]) -> str:
    """The table of all verbs."""
    lines = [
        "| verb | kills | at: first, median, last | had ended | new result | lost | unreadable |",
        "| --- | ---: | --- | ---: | ---: | ---: | ---: |",
    ]
    for name, some in found.items():
        when = np.quantile([kill.at for kill in some], [0, 0.5, 1])
        counts = [
            sum(map(bool, column))
            for column in zip(
                *[(k.ended, k.replaced, k.lost, k.unreadable) for k in some], strict=True
            )
        ]
        cells = [name, len(some), "{:.2f}, {:.2f}, {:.2f}".format(*when), *counts]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Commands killed at random instants.")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=COUNT, help="kills in all")
    parser.add_argument("--verb", choices=tuple(VERBS), help="this one only")
    options = parser.parse_args()
    configure_jax(batches=False, cores=2)
    chosen = [options.verb] if options.verb else [*VERBS]
    whole = sum(VERBS[name].share for name in chosen)
    every: dict[str, list[Kill]] = {}
    with tempfile.TemporaryDirectory() as folder:
        prepare(chosen, Path(folder))
        for number, name in enumerate(chosen):
            count = max(1, round(options.count * VERBS[name].share / whole))
            rng = np.random.default_rng([options.seed, number])
            every[name] = kills(name, count, rng, Path(folder))
            for kill in every[name]:
                if kill.lost or kill.unreadable:
                    print(f"{name} at {kill.at:.3f}: {kill.lost} {kill.unreadable}", flush=True)
    print(table(every))
    sys.exit(any(kill.lost or kill.unreadable for some in every.values() for kill in some))
