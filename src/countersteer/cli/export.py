"""`export`: a run seen from above, as a GIF or an MP4."""

import argparse
import json
import signal
from pathlib import Path

from countersteer.cli.options import DONE, Progress, Verbs, number
from countersteer.errors import InputError
from countersteer.writing import alone

FASTEST_GIF = 50  # frames a second


def add(verbs: Verbs) -> None:
    """The verb with its options."""
    export = verbs.verb("export", "a run seen from above, as a GIF or an MP4", run)
    export.add_argument("source", type=Path, metavar="RUN", help="a run's folder")
    target = export.add_mutually_exclusive_group(required=True)
    target.add_argument("--gif", type=Path, metavar="FILE", help="write an animated GIF")
    target.add_argument("--mp4", type=Path, metavar="FILE", help="write a video (H.264)")
    export.option("--width-px", "PX", number(160, 3840, int), 640, "of the picture")
    meaning = "frames a second (default GIF 20, MP4 25)"
    export.option("--fps", "N", number(1, 100), None, meaning)
    meaning = "times as fast as it was; 0.5 is slow motion"
    export.option("--speed", "X", number(0.01, 100), 1.0, meaning)
    export.add_argument("--follow", action="store_true", help="the camera stays with the car")
    for name, default in (("from", 0.0), ("to", 1e6)):
        meaning = {"from": "begin", "to": "end"}[name] + " (default the run's)"
        export.add_argument(
            f"--{name}-s", type=number(0, 1e6), default=default, metavar="S", help=meaning
        )
    export.add_argument("--force", action="store_true", help="replace a file that is there")


def run(options: argparse.Namespace) -> int:
    """`export`."""
    kind, file = ("gif", options.gif) if options.gif else ("mp4", options.mp4)
    if file.is_dir():
        raise InputError(f"{file}: is a folder: name a file")
    if not file.parent.is_dir():
        raise InputError(f"{file.parent}: no such folder")
    with alone(file):
        if file.exists() and not options.force:
            raise InputError(
                f"{file}: is there already: give another name, or --force to replace it"
            )
        return animate(options, kind, file)


def animate(options: argparse.Namespace, kind: str, file: Path) -> int:
    """The animation of a run, as a file."""
    from countersteer.runs.run import read_run
    from countersteer.viewing.animation import Animation, Options, export

    fps = options.fps or {"gif": 20.0, "mp4": 25.0}[kind]
    if kind == "gif" and fps > FASTEST_GIF:
        raise InputError(f"--fps must be at most {FASTEST_GIF} for a GIF: viewers slow others down")
    drawn = Options(
        options.width_px, fps, options.speed, options.follow, options.from_s, options.to_s
    )
    animation = Animation(read_run(options.source), drawn)
    # What was begun is taken away again: the exception has to come through.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with Progress(options.json) as progress:
            export(animation, file, kind, progress.show)
    finally:
        signal.signal(signal.SIGINT, before)
    width, height = animation.size
    result = {
        "file": str(file),
        "frames": animation.count,
        "duration_s": animation.duration,
        "fps": fps,
        "width_px": width,
        "height_px": height,
    }
    if options.json:
        print(json.dumps(result))
    else:
        size = file.stat().st_size / 1e6
        print(f"{file}: {animation.count} frames, {animation.duration:.1f} s, {size:.1f} MB")
    return DONE
