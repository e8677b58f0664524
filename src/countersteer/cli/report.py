"""`report`: the page and picture of a run from its files, or a page of several side by side."""

import argparse
import json
from pathlib import Path
from typing import Any

from countersteer.cli.options import DONE, WRONG_INPUT, Verbs, complain, in_one_line
from countersteer.cli.recorded import set_up
from countersteer.errors import InputError


def add(verbs: Verbs) -> None:
    """The verb with its options."""
    does = "the page of a run, also of a drive that was killed; or of several runs side by side"
    report = verbs.verb("report", does, run)
    report.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="a run's folder")
    meaning = "the page of several (default in the first one's folder, named after the others)"
    report.option("--out", "FILE", Path, None, meaning)
    meaning = "page and picture of each run, instead of one page with all"
    report.add_argument("--each", action="store_true", help=meaning)


def run(options: argparse.Namespace) -> int:
    """`report`."""
    set_up(options)
    from countersteer import kept_programs

    if len(options.runs) > 1 and not options.each:
        result = compare(options)
        kept_programs.remember(options.verb)
        return result
    if options.out is not None:
        raise InputError("--out: is of a page of several runs; a run's own page is in its folder")
    found, errors = [], []
    for folder in options.runs:
        try:
            found.append(write_report(folder))
        except InputError as error:
            errors.append(in_one_line(error))
            complain(errors[-1])
        else:
            if not options.json:
                print(f"{folder}: {found[-1]['verdict']}; report: {found[-1]['report']}")
    kept_programs.remember(options.verb)
    if options.json:
        print(json.dumps({"reports": found, "errors": errors}))
    return WRONG_INPUT if errors else DONE


def write_report(folder: Path) -> dict[str, Any]:
    """Write page and picture of a run. Raises `InputError` if it cannot have them.

    A run without a path has no picture.
    """
    from countersteer.runs.run import read_run
    from countersteer.viewing.picture import draw_picture
    from countersteer.viewing.report import report_html
    from countersteer.viewing.view import view_of
    from countersteer.writing import whole, write_whole

    run = read_run(folder)
    view = view_of(run)
    page, picture = folder / "report.html", folder / "report.png"
    with whole(page) as part:
        write_whole(part, report_html(view))
        if "x_m" in view:
            draw_picture(view, picture)
    verdict = view["summary"].get("verdict", run.outcome)
    about = {"outcome": run.outcome, "verdict": verdict, "driven_s": float(view["time_s"][-1])}
    drawn = {"picture": str(picture)} if "x_m" in view else {}
    return {"run": str(folder), **about, "report": str(page), **drawn}


def report_of_import(folder: Path) -> dict[str, str]:
    """The `report` of a run that was imported. A log without one is imported all the same."""
    try:
        return {"report": write_report(folder)["report"]}
    except InputError as error:
        complain(f"{in_one_line(error)} (imported, but without a page)")
        return {}


def compare(options: argparse.Namespace) -> int:
    """One page of several runs."""
    from countersteer.runs.run import read_run
    from countersteer.viewing.report import report_html
    from countersteer.viewing.side_by_side import differences, with_places
    from countersteer.viewing.style import MOST_RUNS
    from countersteer.viewing.view import view_of
    from countersteer.writing import write_whole

    folders = options.runs
    if len(folders) > MOST_RUNS:
        raise InputError(
            f"{len(folders)} runs: at most {MOST_RUNS} are shown side by side (--each)"
        )
    views = with_places([view_of(read_run(folder)) for folder in folders])
    others = "-".join(folder.resolve().name for folder in folders[1:])
    page = options.out or folders[0] / f"report-with-{others}.html"
    if page.suffix != ".html":
        raise InputError(f"--out {page}: name a .html file")
    write_whole(page, report_html(*views))
    found = [one for by in ("time", "place") for one in differences(views, by)]
    if options.json:
        print(json.dumps({"report": str(page), "differences": found}))
        return DONE
    for one in found:
        print(f"{one['run']}, at the same {one['by']}: {in_words(one)}")
    print(f"report: {page}")
    return DONE


def in_words(difference: dict[str, Any]) -> str:
    """The differences of a run from the first in a line."""
    shown = (
        ("speed_mps", "speed", "m/s", 2),
        ("sideslip_deg", "sideslip", "°", 1),
        ("yaw_rate_degps", "yaw rate", "°/s", 0),
        ("apart_m", "apart", "m", 2),
    )
    parts = [
        f"{words} {difference[key]['rms']:.{digits}f} {unit}".replace(" °", "°")
        for key, words, unit, digits in shown
        if difference.get(key, {}).get("rms") is not None
    ]
    return ", ".join(parts) + " (root mean square)" if parts else "nothing to compare"
