"""`report`: the page and the picture of a run, made again from its files."""

import argparse
import json
from pathlib import Path
from typing import Any

from countersteer.cli.options import DONE, WRONG_INPUT, Verbs, complain, in_one_line
from countersteer.cli.recorded import set_up
from countersteer.errors import InputError


def add(verbs: Verbs) -> None:
    """The verb with its options."""
    does = "page and picture of runs, made again from their files; also of a drive that was killed"
    report = verbs.verb("report", does, run)
    report.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="a run's folder")


def run(options: argparse.Namespace) -> int:
    """`report`."""
    set_up(options)
    from countersteer import kept_programs

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
    """Write page and picture of a run. Raises `InputError` if it cannot have them."""
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
        draw_picture(view, picture)
    verdict = view["summary"].get("verdict", run.outcome)
    about = {"outcome": run.outcome, "verdict": verdict, "driven_s": view["time_s"][-1]}
    return {"run": str(folder), **about, "report": str(page), "picture": str(picture)}
