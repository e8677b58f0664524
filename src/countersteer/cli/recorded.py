"""What `drive` and `replay` share: a drive that is recorded and shown."""

import argparse
import json
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

from countersteer.cli.options import DONE, FAILED, INTERRUPTED, Progress, complain

if TYPE_CHECKING:
    from countersteer.recorded_drive import Drive


TRACED = 0.9  # s by when the loop has been traced, which needs Python, and is being compiled


def set_up(options: argparse.Namespace) -> None:
    """Sets JAX up for one drive, and loads the compiled programs of the verb's last one."""
    from countersteer import kept_programs
    from countersteer.compiling import configure_jax

    configure_jax(batches=False, cores=2)
    kept_programs.preload(options.verb)


def record(options: argparse.Namespace, what: "Drive", place: str) -> int:
    """Drives, writes the run's folder with its pictures, and prints what came of it."""
    from countersteer.runs.recorder import new_folder

    what.about.update(made_by(options))
    with new_folder(options.out, f"{Path(place).stem}-{what.about['driver']}") as folder:
        return record_into(folder, options, what)


def made_by(options: argparse.Namespace) -> dict[str, str]:
    """The command, for a run's `run.toml`, if it is one that reads well there."""
    from countersteer.runs.keys import LONGEST_TEXT

    command = str(options.command)
    return {"command": command} if command.isprintable() and len(command) < LONGEST_TEXT else {}


def record_into(folder: Path, options: argparse.Namespace, what: "Drive") -> int:
    """`record`, in a new folder."""
    from countersteer import kept_programs
    from countersteer.recorded_drive import drive
    from countersteer.runs.run import read_run
    from countersteer.viewing.picture import Painter
    from countersteer.viewing.report import report_html
    from countersteer.viewing.view import view_of
    from countersteer.writing import write_whole

    painter = Painter()
    beside = threading.Timer(TRACED, prepare_the_rest, args=(what,))
    beside.start()
    try:
        with Progress(options.json) as progress:
            result = drive(what, folder, progress.show)
    except BaseException:
        painter.cancel()
        raise
    finally:
        beside.cancel()  # a drive that ended before it needs no help
        beside.join()
    view = view_of(read_run(folder))
    painter.draw(view)
    write_whole(folder / "report.html", report_html(view))
    kept_programs.remember(options.verb)
    if options.json:
        print(json.dumps(result | {"out": str(folder)}))
    else:
        print_result(result, folder)
    painter.finish(folder / "report.png")
    if result["outcome"] == "interrupted":
        complain("interrupted")
        return INTERRUPTED
    return DONE if result["success"] else FAILED


def prepare_the_rest(what: "Drive") -> None:
    """Compiles what judge and page need, on another core than the one that compiles the loop."""
    from countersteer.recorded_drive import warm_up
    from countersteer.viewing import view

    warm_up(what)
    view.warm_up(what.simulator.car, getattr(what.simulator.world, "floor", None))


def print_result(result: dict[str, Any], folder: Path) -> None:
    """The summary for a person."""
    print("\n".join(summary_lines(result)))
    print(f"report: {folder / 'report.html'}")


def summary_lines(result: dict[str, Any]) -> list[str]:
    """The judge's summary of a drive in words."""
    lap = f" in {result['lap_time_s']:.2f} s" if result["lap_time_s"] else ""
    touched = result["wall_contacts"]
    return [
        f"{result['verdict']}{lap}, {touched} wall contact{'s' if touched != 1 else ''}",
        *(
            f"  turn {i}: in at {turn['entry_speed_mps']:.2f} m/s, "
            f"sideslip {turn['peak_sideslip_deg']:.0f}°, "
            f"yaw rate {turn['peak_yaw_rate_degps']:.0f} °/s, "
            f"{turn['heading_overshoot_deg']:.0f}° too far and back, "
            f"out {turn['heading_error_deg']:+.1f}° off after {turn['duration_s']:.2f} s"
            for i, turn in enumerate(result["turns"], start=1)
        ),
    ]
