"""`export`: what is in the files, read back."""

import builtins
import json
import math
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image, ImageColor

from countersteer import cli
from countersteer.runs.run import read_run
from countersteer.viewing import animation as module
from countersteer.viewing.animation import PAINT, Animation, Options

SECONDS, STEP = 4.0, 0.01


def write_run(folder: Path, truth: str | None, walls: bool = True) -> Path:
    """A run of the library's car, without driving it."""
    folder.mkdir()
    course = "[course]\nname = 'ring'\nwalls_m = [[-3, -2, 3, -2], [-3, 2, 3, 2]]\n"
    (folder / "run.toml").write_text("car_name = 'rx7'\n" + (course if walls else ""))
    (folder / "commands.csv").write_text(
        "time_s,throttle,direction,steering_deg\n0,0.4,forward,10\n2,0.2,forward,-10\n"
    )
    (folder / "telemetry.csv").write_text("time_s,gyro_radps\n0,1\n")
    if truth is not None:
        (folder / "truth.csv").write_text(truth)
    return folder


def circle(velocities: bool = True) -> str:
    """Four seconds on a circle of 1 m, with 20° of sideslip."""
    header = "time_s,x_m,y_m,heading_rad" + (",vx_mps,vy_mps,yaw_rate_radps" if velocities else "")
    lines = [header]
    for k in range(round(SECONDS / STEP) + 1):
        t = k * STEP
        values = [t, math.cos(t), math.sin(t), t + math.pi / 2 - math.radians(20)]
        if velocities:
            values += [math.cos(math.radians(20)), math.sin(math.radians(20)), 1.0]
        lines.append(",".join(map(repr, values)))
    return "\n".join(lines) + "\n"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_run(tmp_path / "run", circle())


def export(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, Any]:
    """Exit status, and the JSON or the error that was printed."""
    capsys.readouterr()
    status = cli.main(["export", *map(str, arguments), "--json"])
    out, errors = capsys.readouterr()
    return status, json.loads(out) if status == 0 else errors


def paint(image: Image.Image, near: int = 40) -> np.ndarray:
    """Centre of the pixels of the floor that have the colour of the car's body."""
    image = image.crop((0, 0, round(image.width * 450 / 640), image.height))
    wanted = np.array(ImageColor.getrgb(PAINT))
    away = np.abs(np.asarray(image.convert("RGB"), int) - wanted).sum(axis=2)
    y, x = np.nonzero(away < near)
    assert len(x) > 20
    return np.array([x.mean(), y.mean()]) + 0.5


def test_a_gif_has_the_frames_size_and_length_that_were_told(run, tmp_path, capsys):
    file = tmp_path / "run.gif"
    status, told = export(capsys, run, "--gif", file, "--width-px", 320, "--fps", 15)
    assert status == 0
    assert told["file"] == str(file)
    with Image.open(file) as gif:
        assert gif.size == (told["width_px"], told["height_px"])
        assert gif.width == 320
        assert gif.n_frames == told["frames"] == 60
        assert gif.info["loop"] == 0
        length = 0
        for k in range(gif.n_frames):
            gif.seek(k)
            length += gif.info["duration"]
    assert length / 1000 == pytest.approx(told["duration_s"], abs=0.011)
    assert told["duration_s"] == pytest.approx(SECONDS)


def test_an_mp4_has_the_frames_size_and_length_that_were_told(run, tmp_path, capsys):
    file = tmp_path / "run.mp4"
    status, told = export(
        capsys, run, "--mp4", file, "--speed", 0.5, "--from-s", 1, "--to-s", 2.5, "--width-px", 400
    )
    assert status == 0
    assert told["duration_s"] == pytest.approx(3)
    with av.open(str(file)) as video:
        (stream,) = video.streams.video
        assert stream.average_rate == told["fps"] == 25
        assert stream.codec_context.name == "h264"
        frames = [frame.to_image() for frame in video.decode(stream)]
        assert video.duration / av.time_base == pytest.approx(3, abs=0.05)
    assert len(frames) == told["frames"] == 75
    assert frames[0].size == (told["width_px"], told["height_px"])
    drawn = Animation(read_run(run), Options(width=400, fps=25, speed=0.5, begin=1, end=2.5))
    t = drawn.moments[40]
    pose = np.array([math.cos(t), math.sin(t), 0])
    np.testing.assert_allclose(paint(frames[40], near=90), drawn.pixel(pose[:2], pose), atol=3)


@pytest.mark.parametrize("follow", [False, True])
@pytest.mark.parametrize("walls", [False, True])
def test_the_car_is_drawn_where_the_truth_says(tmp_path, follow, walls):
    run = read_run(write_run(tmp_path / "run", circle(), walls))
    drawn = Animation(run, Options(fps=3, follow=follow))
    frames = list(drawn.frames(drawn.moments))
    assert len(frames) == drawn.count == 12
    for t, frame in zip(drawn.moments.tolist(), frames, strict=True):
        pose = np.array([math.cos(t), math.sin(t), 0])
        place = drawn.pixel(pose[:2], pose)
        assert frame.size == drawn.size
        np.testing.assert_allclose(paint(frame), place, atol=3)
    corners = run.walls.reshape(-1, 2)
    if not follow and walls:
        pixels = drawn.pixel(corners, drawn.moments[:3])
        assert np.all(pixels > 0)
        assert np.all(pixels < drawn.size)
        wall = drawn.pixel(np.array([0.0, -2.0]), drawn.moments[:3]).astype(int)
        assert sum(frames[0].getpixel(tuple(wall.tolist()))) < 250


def test_the_trail_is_what_was_driven_so_far(run):
    drawn = Animation(read_run(run), Options(fps=2))
    early, late = (np.asarray(next(drawn.frames(drawn.moments[k : k + 1]))) for k in (2, 6))
    t = drawn.moments[4]
    x, y = drawn.pixel(np.array([math.cos(t), math.sin(t)]), np.zeros(3)).astype(int)
    around = np.s_[y - 2 : y + 3, x - 2 : x + 3]
    floor = np.array(ImageColor.getrgb(module.picture.FLOOR))
    assert np.abs(early[around] - floor).max() < 30
    assert np.abs(late[around].astype(int) - floor).max() > 100


def test_a_run_with_only_poses_is_drawn_too(tmp_path, capsys):
    run = write_run(tmp_path / "run", circle(velocities=False), walls=False)
    status, told = export(capsys, run, "--gif", tmp_path / "a.gif", "--fps", 5)
    assert status == 0
    assert told["frames"] == 20


def test_an_animation_of_poses_shows_speed_and_sideslip_as_that_of_velocities_does(tmp_path):
    for velocities in (True, False):
        run = write_run(tmp_path / f"run{velocities}", circle(velocities))
        speed, sideslip, yaw_rate, _ = Animation(read_run(run), Options())._strips
        assert (speed.name, sideslip.name, yaw_rate.name) == ("Speed", "Sideslip", "Yaw rate")
        np.testing.assert_allclose(speed.values[20:-20], 1, atol=0.002)
        np.testing.assert_allclose(sideslip.values[20:-20], 20, atol=0.1)


def test_what_cannot_be_drawn_is_told_in_one_line(run, tmp_path, capsys):
    blind = write_run(tmp_path / "blind", None)
    for source, options, message in (
        (blind, (), "no truth.csv"),
        (tmp_path / "nothing", (), "no such run"),
        (run, ("--from-s", 9), "--from-s"),
        (run, ("--from-s", 2, "--to-s", 1), "--from-s"),
        (run, ("--fps", 90), "--fps"),
        (run, ("--width-px", 3), "160"),
    ):
        file = tmp_path / "a.gif"
        status, errors = export(capsys, source, "--gif", file, *options)
        assert status == 2
        assert message in errors
        assert errors.count("\n") == 1
        assert not file.exists()
    status, errors = export(capsys, run, "--gif", tmp_path / "none" / "a.gif")
    assert status == 2
    assert "no such folder" in errors


def test_a_file_that_is_there_is_kept_unless_forced(run, tmp_path, capsys):
    file = tmp_path / "a.gif"
    file.write_text("mine")
    status, errors = export(capsys, run, "--gif", file)
    assert status == 2
    assert "--force" in errors
    assert file.read_text() == "mine"
    assert export(capsys, run, "--gif", file, "--force", "--fps", 2)[0] == 0
    assert file.read_bytes().startswith(b"GIF89a")


@pytest.mark.parametrize("kind", ["gif", "mp4"])
def test_an_interrupt_leaves_no_half_file(run, tmp_path, kind, monkeypatch, capsys):
    def interrupt(*arguments: Any) -> None:
        if arguments[1] == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(cli.Progress, "show", interrupt)
    before = set(tmp_path.iterdir())
    status, _ = export(capsys, run, f"--{kind}", tmp_path / "a.bin")
    assert status == 130
    assert set(tmp_path.iterdir()) == before


def test_without_the_library_for_mp4_one_line_says_what_to_install(
    run, tmp_path, monkeypatch, capsys
):
    def missing(name: str, *rest: Any) -> Any:
        if name == "av":
            raise ImportError(name)
        return original(name, *rest)

    original = builtins.__import__
    monkeypatch.setattr(builtins, "__import__", missing)
    status, errors = export(capsys, run, "--mp4", tmp_path / "a.mp4")
    assert status == 2
    assert "pip install av" in errors
    assert not (tmp_path / "a.mp4").exists()
