"""Courses from other people's files: centre lines with widths, and occupancy maps."""

import functools
import importlib.util
import math
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import jax
import numpy as np
import pytest
import tomli_w
from PIL import Image, ImageDraw
from scipy.spatial import KDTree

from countersteer import cli
from countersteer.car.files import load_car
from countersteer.course.course import Course, from_segments, progress
from countersteer.course.files import course_of_run, course_tables, load_course
from countersteer.course.position import line_of
from countersteer.course.way import SPACING, way_of
from countersteer.errors import InputError

HEADER = "# x_m, y_m, w_tr_right_m, w_tr_left_m\n"
RIGHT, LEFT = 0.9, 1.3
ANGLES = np.linspace(0, 2 * math.pi, 20_001)[:-1]


def oval(angle: np.ndarray) -> np.ndarray:
    return np.stack([6 * np.cos(angle), 4 * np.sin(angle)], axis=1)


def kidney(angle: np.ndarray) -> np.ndarray:
    radius = 5 + 1.2 * np.cos(2 * angle) + 0.7 * np.sin(angle)
    return radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def loop(seed: int) -> Callable[[np.ndarray], np.ndarray]:
    """A random smooth loop round the origin, with bends tighter than its widths in it."""
    draws = np.random.default_rng(seed).normal(0, 0.35, (4, 2))

    def points(angle: np.ndarray) -> np.ndarray:
        waves = [a * np.cos(k * angle) + b * np.sin(k * angle) for k, (a, b) in enumerate(draws, 2)]
        radius = 6 * np.exp(0.5 * np.sum(waves, axis=0))
        return radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    return points


SHAPES = {"oval": oval, "kidney": kidney, "loop": loop(3)}


def write_csv(path: Path, points: np.ndarray, right: float = RIGHT, left: float = LEFT) -> str:
    rows = "".join(f"{x:.6f}, {y:.6f}, {right}, {left}\n" for x, y in points)
    path.write_text(HEADER + rows)
    return str(path)


def along_walls(course: Course) -> np.ndarray:
    """Points on all walls, 1 cm apart or less."""
    pieces = []
    for x1, y1, x2, y2 in course.walls:
        at = np.linspace(0, 1, 2 + int(100 * math.hypot(x2 - x1, y2 - y1)))[:, None]
        pieces.append((1 - at) * [x1, y1] + at * [x2, y2])
    return np.concatenate(pieces)


def beside(curve: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distance of points from a closed curve, positive to its left."""
    away, nearest = KDTree(curve).query(points)
    ahead = (np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0))[nearest]
    to = points - curve[nearest]
    return np.copysign(away, ahead[:, 0] * to[:, 1] - ahead[:, 1] * to[:, 0])


@pytest.fixture(scope="module")
def grip_limit() -> ModuleType:
    path = Path(__file__).parents[1] / "examples" / "grip_limit.py"
    spec = importlib.util.spec_from_file_location("grip_limit", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# Centre lines


@pytest.mark.parametrize("name", ["oval", "kidney"])
def test_the_walls_of_a_centre_line_are_at_its_widths(name, tmp_path):
    shape = SHAPES[name]
    course = load_course(write_csv(tmp_path / "track.csv", shape(ANGLES[::100])))
    curve, tolerance = shape(ANGLES), 0.01 * (RIGHT + LEFT) + 0.002  # the line itself is chords
    off = beside(curve, along_walls(course))
    assert np.max(np.abs(off[off > 0] - LEFT)) < tolerance
    assert np.max(np.abs(off[off < 0] + RIGHT)) < tolerance
    walls = KDTree(along_walls(course))
    ahead = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
    normal = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) / np.hypot(*ahead.T)[:, None]
    for aside in (LEFT, -RIGHT):  # no wall is missing anywhere
        assert np.max(walls.query(curve + aside * normal)[0]) < tolerance + 0.01
    assert len(course.walls) < 120
    assert course.name == "track"
    assert course.closed
    assert course.width == pytest.approx(RIGHT + LEFT)
    assert np.all(course.sides == [RIGHT, LEFT])
    assert course.line[:-1] == pytest.approx(shape(ANGLES[::100]), abs=1e-6)
    assert course.goal_distance == course.length
    assert course.start[:2] == pytest.approx(shape(ANGLES[:1])[0], abs=1e-6)
    first = shape(ANGLES[:200:100])
    heading = math.atan2(*(first[1] - first[0])[::-1])
    assert course.start[2] == pytest.approx(heading, abs=1e-4)


@pytest.mark.parametrize("seed", range(8))
def test_no_wall_stands_in_the_corridor_where_bends_are_tight(seed, tmp_path):
    curve, width = loop(seed)(ANGLES), 0.9
    course = load_course(write_csv(tmp_path / "a.csv", loop(seed)(ANGLES[::50]), width, width))
    away = KDTree(curve).query(along_walls(course))[0]
    assert np.min(away) > width - 0.01 * 2 * width - 0.01
    assert len(course.walls) < 300


def test_a_width_that_varies_is_kept_point_by_point(tmp_path):
    points = oval(ANGLES[::100])
    right = 0.7 + 0.3 * np.cos(ANGLES[::100])
    path = tmp_path / "a.csv"
    rows = np.column_stack([points, right, np.full(len(points), 1.0)])
    np.savetxt(path, rows, delimiter=",")
    course = load_course(str(path))
    assert course.sides[:-1] == pytest.approx(rows[:, 2:])
    assert course.width == pytest.approx(1.4)
    walls = KDTree(along_walls(course))
    outer = points * (1 + right / np.hypot(*points.T))[:, None]  # at the ends of the axes
    for i in (0, len(points) // 2):
        assert walls.query(outer[i])[0] < 0.03


def test_files_that_say_the_same_in_other_words_make_the_same_course(tmp_path):
    points = np.round(kidney(ANGLES[::100]), 6)
    plain = load_course(write_csv(tmp_path / "a.csv", points))
    rows = [f"{x:.6f},{y:.6f},{RIGHT},{LEFT}" for x, y in points]
    named = [
        f"{i}; {0.1 * i:.1f}; {x:.6f}; {y:.6f}; {RIGHT}; {LEFT}; 0.0"
        for i, (x, y) in enumerate(points)
    ]
    others = {
        "no header": "\n".join(rows),
        "first again at the end": HEADER + "\n".join([*rows, rows[0]]) + "\n",
        "a point twice": "\n".join([rows[0], *rows]),
        "bare header": "x_m,y_m,w_tr_right_m,w_tr_left_m\n" + "\n".join(rows),
        "other columns": "id; s_m; x_m; y_m; d_right; d_left; psi_rad\n" + "\n".join(named),
        "comments": "# made by hand\n" + HEADER + "\n\n".join(rows),
        "from Windows": "\ufeff" + HEADER.replace("\n", "\r\n") + "\r\n".join(rows),
        "blanks": "\n".join(row.replace(",", "  ") for row in rows),
        "a title": "# A lap, by hand\n" + "\n".join(rows),
        "a separator at the end": "\n".join(row + "," for row in [HEADER.strip(), *rows]),
        "race line's names": "# x_ref_m; y_ref_m; width_right_m; width_left_m\n"
        + "\n".join(rows).replace(",", ";"),
        "names of a planner": "d_left_iqp,x_m,d_right_iqp,y_m\n"
        + "\n".join(f"{LEFT},{x:.6f},{RIGHT},{y:.6f}" for x, y in points),
        "short names": "x,y,w_right,w_left\n" + "\n".join(rows),
    }
    for what, text in others.items():
        (tmp_path / "a.csv").write_bytes(text.encode())
        course = load_course(str(tmp_path / "a.csv"))
        assert np.array_equal(course.line, plain.line), what
        assert np.array_equal(course.walls, plain.walls), what
        assert np.array_equal(course.sides, plain.sides), what


@functools.cache
def way_points() -> dict[str, np.ndarray]:
    """Columns of a way-point file along an oval."""
    points = oval(ANGLES[::200])
    steps = np.roll(points, -1, axis=0) - points
    heading = np.arctan2(*steps.T[::-1])
    return {
        "x": points[:, 0],
        "y": points[:, 1],
        "yaw": heading,
        "yaw to 360": np.mod(heading, 2 * math.pi),
        "yaw, unwrapped": np.unwrap(heading) + 9,
        "yaw, noisy": np.mod(heading + np.random.default_rng(0).normal(0, 0.2, 100), 2 * math.pi),
        "degrees": np.degrees(np.mod(heading, 2 * math.pi)),
        "compass": np.degrees(np.mod(math.pi / 2 - heading, 2 * math.pi)),
        "distance": np.cumsum(np.hypot(*steps.T)),
        "speed": np.full(100, 3.0),
    }


@pytest.mark.parametrize(
    ("columns", "says"),
    [
        ("x y yaw speed", "column 3 is the heading of the line"),
        ("x y|yaw to 360|speed", "column 3 is the heading of the line"),
        ("x y|yaw, unwrapped|speed", "column 3 is the heading of the line"),
        ("x y|yaw, noisy|speed", "column 3 is the heading of the line"),
        ("x y degrees speed", "column 3 is the heading of the line"),
        ("x y speed compass", "column 4 is the heading of the line"),
        ("x y distance speed", "column 3 rises from row to row"),
        ("distance x y speed", "w_tr_right_m must be a number in [0, 1000]"),
        ("x y speed", "3 cells, not 4 (x_m, y_m, w_tr_right_m, w_tr_left_m)"),
        ("x y speed speed speed", "5 cells, not 4 (x_m, y_m, w_tr_right_m, w_tr_left_m)"),
    ],
)
@pytest.mark.parametrize("back", [False, True])
def test_way_points_without_a_header_are_no_centre_line(columns, says, back, tmp_path):
    known = way_points()
    names = [
        name for part in columns.split("|") for name in ([part] if part in known else part.split())
    ]
    table = np.column_stack([known[name] for name in names])
    if back:  # clockwise: the heading is another, but still it is the line's
        table = table[::-1] * np.where(np.array(names) == "distance", -1, 1)
        table[:, np.array(names) == "distance"] += known["distance"][-1]
    path = tmp_path / "way.csv"
    np.savetxt(path, table, delimiter=",")
    refused(path, says)


@pytest.mark.parametrize("header", ["{}\n", "# {}\n", "# 5f3a\n# {}\n"])
@pytest.mark.parametrize(
    ("names", "says"),
    [
        ("x; y; yaw; speed", "w_tr_left_m are missing: a race line and way points"),
        ("s_m; x_m; y_m; psi_rad; kappa_radpm; vx_mps; ax_mps2", "a race line and way points"),
        ("pos_x; pos_y; yaw; speed", "column x_m is missing"),
        ("x_cm; y_cm; w_tr_right_cm; w_tr_left_cm", "column x_m is missing"),
        ("x_m; y_m; x_ref_m; y_ref_m; d_right; d_left", "x_m, x_ref_m both say x_m"),
        ("x_m; y_m; w_tr_right_m; speed", "column w_tr_left_m is missing"),
    ],
)
def test_a_header_that_names_no_centre_line_says_why(header, names, says, tmp_path):
    path = tmp_path / "line.csv"
    cells = names.count(";") - 1
    rows = [f"{x:.4f}; {y:.4f}" + "; 1" * cells for x, y in oval(ANGLES[::200])]
    path.write_text(header.format(names) + "\n".join(rows))
    refused(path, says)


def test_points_of_both_walls_make_the_same_course(tmp_path):
    points = oval(ANGLES[::100])
    course = load_course(write_csv(tmp_path / "a.csv", points, 0.8, 0.8))
    ahead = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    aside = 0.8 * np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) / np.hypot(*ahead.T)[:, None]
    table = np.hstack([points + aside, points - aside])
    header = "x_left_m,y_left_m,x_right_m,y_right_m"
    np.savetxt(tmp_path / "b.csv", table, delimiter=",", header=header)
    edges = load_course(str(tmp_path / "b.csv"))
    assert edges.line == pytest.approx(course.line, abs=1e-5)
    assert edges.sides == pytest.approx(course.sides, abs=1e-5)
    assert np.max(np.abs(beside(oval(ANGLES), along_walls(edges)))) < 0.82


def test_a_clockwise_line_is_driven_clockwise_and_one_side_may_have_no_room(tmp_path):
    points = oval(ANGLES[::100])
    course = load_course(write_csv(tmp_path / "a.csv", points[::-1], 0.0, 1.0))
    off = beside(oval(ANGLES), along_walls(course))  # positive inside
    assert np.min(off) == pytest.approx(-1.0, abs=0.02)
    assert np.max(off) == pytest.approx(0.0, abs=0.02)
    assert course.start[2] == pytest.approx(-math.pi / 2, abs=0.2)


@pytest.mark.parametrize(
    ("points", "says"),
    [
        (oval(ANGLES[:12_000:100]), "no lap: the last point is"),
        (np.zeros((20, 2)), "0 points that differ"),
        (oval(ANGLES[::100]) * [1, 0], "the centre line crosses itself"),
    ],
)
def test_a_line_that_is_no_lap_is_refused(points, says, tmp_path):
    refused(Path(write_csv(tmp_path / "a.csv", points)), says)


CIRCLE = "".join(f"{3 * math.cos(a)},{3 * math.sin(a)},1,1\n" for a in ANGLES[::1000])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "0 points that differ, not 3 to"),
        ("0,0,1,1\n1,0,1,1\n", "2 points that differ, not 3 to"),
        (CIRCLE + "nan,0,1,1\n", "line 21: x_m must be a number in"),
        (CIRCLE + "0,inf,1,1\n", "line 21: y_m must be a number in"),
        (CIRCLE + "0,0,-1,1\n", "line 21: w_tr_right_m must be a number in [0, 1000], not -1.0"),
        (CIRCLE + "0,0,0,0\n", "line 21: less than 0.05 m wide"),
        (CIRCLE + "0,0,1\n", "line 21: 3 cells, not 4"),
        (CIRCLE + "a,b,c,d\n", "line 21: x_m must be a number"),
        ("# s_m; x_m; y_m; psi_rad\n0;0;0;0\n", "w_tr_right_m and w_tr_left_m are missing: a race"),
        ("0,0,1,1\n9,9,1,1\n9,0,1,1\n0,9,1,1\n", "the centre line crosses itself"),
        (CIRCLE.replace(",1,1", ",1,4"), "leave no wall inside the lap"),
        ("\0\1", "column x_m is missing"),
    ],
)
def test_a_wrong_centre_line_is_refused_in_one_line(text, says, tmp_path):
    path = tmp_path / "track.csv"
    path.write_text(text)
    refused(path, says)


def refused(path: Path, says: str) -> None:
    with pytest.raises(InputError) as caught:
        load_course(str(path))
    assert says in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_is_no_text_or_not_there_is_refused(tmp_path):
    for name in ("track.csv", "map.yaml"):
        refused(tmp_path / name, "cannot be read: No such file")
        (tmp_path / name).write_bytes(b"\xff\xfe\xfa")
        refused(tmp_path / name, "cannot be read: it is not text")
    with pytest.raises(InputError, match=r"or the path of a \.toml, \.csv or \.yaml file"):
        load_course("map.png")


# Maps

RESOLUTION, YAW, ORIGIN = 0.04, 0.4, (-3.6, -4.3)
FREE, UNKNOWN, WALL = 254, 205, 0


def write_map(folder: Path, drawn: Image.Image, ending: str = "png", **changes: object) -> str:
    """A map's two files; `changes` to the keys, None to leave one out."""
    drawn.save(folder / f"map.{ending}")
    about = {
        "image": f"map.{ending}",
        "resolution": RESOLUTION,
        "origin": [*ORIGIN, YAW],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    } | changes
    lines = [f"{key}: {value}\n" for key, value in about.items() if value is not None]
    (folder / "map.yaml").write_text("# a map\n" + "".join(lines))
    return str(folder / "map.yaml")


@functools.cache
def ring(shape: Callable, half: float = 1.0) -> tuple[Image.Image, np.ndarray]:
    """An image of the corridor along a shape, and that shape's curve; the start is the origin."""
    curve = shape(ANGLES) - shape(ANGLES[:1])
    curve = curve @ np.array([[0.0, -1.0], [1.0, 0.0]])  # ahead along x
    column, row = np.meshgrid(np.arange(420), np.arange(420)[::-1])  # row 0 of an image is on top
    x, y = (column.ravel() + 0.5) * RESOLUTION, (row.ravel() + 0.5) * RESOLUTION
    cosine, sine = math.cos(YAW), math.sin(YAW)
    places = np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=1) + ORIGIN
    away = np.abs(beside(curve[::4], places)).reshape(column.shape)
    shades = np.where(away < half, FREE, np.where(away < half + 0.2, WALL, UNKNOWN))
    return Image.fromarray(shades.astype(np.uint8)), curve


def around(curve: np.ndarray) -> np.ndarray:
    return np.roll(curve, -1, axis=0) - curve


@pytest.mark.parametrize("ending", ["png", "pgm"])
@pytest.mark.parametrize("name", ["oval", "kidney"])
def test_a_ring_in_a_map_is_a_closed_course_along_its_middle(name, ending, tmp_path):
    image, curve = ring(SHAPES[name])
    course = load_course(write_map(tmp_path, image, ending))
    off = beside(curve, along_walls(course))
    # One pixel is the simplification's, and a part of one is the drawing's.
    assert np.max(np.abs(np.abs(off) - 1.0)) < 1.2 * RESOLUTION
    for side in (off[off > 0], off[off < 0]):
        assert abs(np.mean(np.abs(side)) - 1.0) < 0.2 * RESOLUTION
    assert len(course.walls) < 100
    assert course.closed
    assert np.max(np.abs(beside(curve, course.line))) < 0.6 * RESOLUTION
    assert np.max(KDTree(course.line).query(curve)[0]) < 2 * RESOLUTION
    assert course.sides == pytest.approx(1.0, abs=0.75 * RESOLUTION)
    assert math.hypot(*course.start[:2]) < 2 * RESOLUTION
    heading = math.atan2(*around(curve)[0, ::-1])
    assert course.start[2] == pytest.approx(heading, abs=0.05)
    assert course.length == pytest.approx(np.sum(np.hypot(*around(curve).T)), rel=0.01)
    back = load_course(write_map(tmp_path, image, ending, reverse="true"))
    assert math.cos(back.start[2] - heading) == pytest.approx(-1.0, abs=0.002)
    assert np.array_equal(back.walls, course.walls)
    assert np.array_equal(np.sort(back.line[:-1], axis=0), np.sort(course.line[:-1], axis=0))


def room(size: int = 120) -> Image.Image:
    """A room of 5 m by 5 m, the origin (ROOM below) in its middle, in unknown land."""
    image = Image.new("L", (size, size), UNKNOWN)
    ImageDraw.Draw(image).rectangle((10, 10, 109, 109), fill=FREE)
    return image


ROOM = {"origin": [-3.0, -3.0, 0.0], "resolution": 0.05}
SQUARE = {-2.5, 2.5}


def corners(course: Course) -> set[tuple[float, float]]:
    """Ends of walls, to the next half metre (a corner is cut by half a pixel)."""
    return {(round(2 * x) / 2, round(2 * y) / 2) for x, y in course.walls[:, :2]}


def test_a_room_with_pillars_has_free_walls(tmp_path):
    image = room()
    draw = ImageDraw.Draw(image)
    draw.rectangle((30, 30, 39, 39), fill=WALL)
    draw.rectangle((80, 80, 89, 89), fill=UNKNOWN)
    draw.point([(50, 50), (51, 50), (70, 90)], fill=WALL)  # noise
    draw.rectangle((112, 10, 118, 100), fill=FREE)  # another room
    course = load_course(write_map(tmp_path, image, **ROOM))
    assert not course.closed
    assert course.width is None
    assert course.goal_distance is None
    assert course.start == (0.0, 0.0, 0.0)
    square = {(x, y) for x in SQUARE for y in SQUARE}
    first = {(x, y) for x in (-1.5, -1.0) for y in (1.0, 1.5)}
    second = {(x, y) for x in (1.0, 1.5) for y in (-1.5, -1.0)}
    assert corners(course) == square | first | second
    assert np.max(np.abs(course.walls)) == pytest.approx(2.5, abs=0.01)


def test_a_wall_one_pixel_thick_does_not_leak(tmp_path):
    image = room()
    ImageDraw.Draw(image).line((10, 70, 49, 109), fill=WALL)  # pixels that meet at corners only
    course = load_course(write_map(tmp_path, image, **ROOM))
    assert (-2.5, -2.5) not in corners(course)
    assert {(-2.5, -0.5), (-0.5, -2.5)} <= corners(course)


def test_the_same_map_in_other_shades_makes_the_same_course(tmp_path):
    image, _ = ring(oval)
    shades = np.asarray(image)
    plain = load_course(write_map(tmp_path, image))
    clear = np.dstack([np.full_like(shades, 254)] * 3 + [np.where(shades == FREE, 255, 0)])
    others = {
        "negate": (Image.fromarray(255 - shades), {"negate": "true"}),
        "scale": (image, {"mode": "scale"}),
        "raw": (
            Image.fromarray(np.where(shades == FREE, 0, 100).astype(np.uint8)),
            {"mode": "raw"},
        ),
        "colour": (image.convert("RGB"), {}),
        "transparent": (Image.fromarray(clear.astype(np.uint8)), {}),
        "16 bits": (Image.fromarray(shades.astype(np.uint16) * 257), {}),
        "1 bit": (Image.fromarray(shades == FREE), {}),
        "no thresholds": (
            Image.fromarray(np.where(shades == UNKNOWN, WALL, shades).astype(np.uint8)),
            {"free_thresh": None, "occupied_thresh": None, "negate": None},
        ),
        "a number as text": (image, {"resolution": "4e-2"}),
    }
    for what, (other, changes) in others.items():
        course = load_course(write_map(tmp_path, other, **changes))
        assert np.array_equal(course.walls, plain.walls), what
        assert np.array_equal(course.line, plain.line), what


def test_grey_is_free_or_not_as_the_threshold_says(tmp_path):
    course = load_course(write_map(tmp_path, room(), **ROOM, free_thresh=0.2, mode="scale"))
    assert corners(course) == {(x, y) for x in (-3.0, 3.0) for y in (-3.0, 3.0)}


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"image": None}, "image is missing"),
        ({"resolution": None}, "resolution is missing"),
        ({"origin": None}, "origin is missing"),
        ({"image": "no.png"}, "No such file"),
        ({"image": "map.yaml"}, "no picture that can be read"),
        ({"resolution": 0}, "resolution must be a number in [0.0001, 10], not 0"),
        ({"resolution": -0.05}, "resolution must be a number in"),
        ({"resolution": ".nan"}, "resolution must be a number in"),
        ({"resolution": "true"}, "resolution must be a number in"),
        ({"origin": "[0, 0]"}, "origin must be [x, y, yaw]"),
        ({"origin": "[0, 0, .inf]"}, "origin must be a number in"),
        ({"origin": "[0, 0, north]"}, "origin must be a number in"),
        ({"negate": 2}, "negate must be true or false, not 2"),
        ({"mode": "best"}, "mode must be trinary, scale or raw, not 'best'"),
        ({"free_thresh": 2}, "free_thresh must be a number in [0, 1], not 2"),
        ({"free_thresh": 0}, "map.png has no free pixel"),
        ({"origin": "[20, 20, 0]"}, "the origin (0, 0), where the car starts, is not free"),
        ({"image": "[1, 2"}, "not valid YAML"),
        ({"image": "!!python/object/apply:os.getcwd []"}, "not valid YAML"),
    ],
)
def test_a_wrong_map_is_refused_in_one_line(changes, says, tmp_path):
    path = Path(write_map(tmp_path, room(), **ROOM | changes))
    refused(path, says)


def test_images_that_are_damaged_or_huge_are_refused(tmp_path):
    path = Path(write_map(tmp_path, room(), **ROOM))
    whole = (tmp_path / "map.png").read_bytes()
    (tmp_path / "map.png").write_bytes(whole[: len(whole) // 2])
    refused(path, "no picture that can be read")
    for size in ((10_000, 5_000), (10_000, 10_000), (100_000, 100_000)):
        (tmp_path / "map.png").write_bytes(b"P5 %d %d 255\n" % size)
        refused(path, "pixels")
    for text in ("3", "", "- 1\n"):
        path.write_text(text)
        refused(path, "not a map")


def test_a_map_of_noise_is_refused(tmp_path):
    noise = np.random.default_rng(0).random((400, 400)) < 0.7
    noise[195:205, 195:205] = True
    image = Image.fromarray(np.where(noise, FREE, WALL).astype(np.uint8))
    refused(Path(write_map(tmp_path, image, origin="[-8, -8, 0]")), "pieces of wall, over")


# Both


def test_a_run_on_a_track_keeps_its_course_whole(tmp_path):
    image, _ = ring(kidney)
    for name in (write_csv(tmp_path / "a.csv", kidney(ANGLES[::100])), write_map(tmp_path, image)):
        course = load_course(name)
        again = course_of_run(tomllib.loads(tomli_w.dumps({"course": course_tables(course)})))
        for field in ("line", "walls", "sides"):
            assert np.array_equal(getattr(again, field), getattr(course, field))
        assert again.start == course.start
        assert (again.width, again.closed, again.name) == (course.width, True, course.name)
        assert (again.goal_distance, again.turns) == (course.length, ())


def test_drift_turn_refuses_a_course_without_corners(tmp_path, capsys):
    name = write_csv(tmp_path / "a.csv", oval(ANGLES[::100]))
    assert cli.main(["drive", name]) == 2
    assert "drift-turn needs straights with corners" in capsys.readouterr().err


def test_the_example_laps_a_centre_line_and_a_map(grip_limit, tmp_path, capsys, monkeypatch):
    image, _ = ring(kidney)
    tracks = (
        write_csv(tmp_path / "a.csv", kidney(ANGLES[::100]), 1.0, 1.0),
        write_map(tmp_path, image),
    )
    times = []
    for track in tracks:
        monkeypatch.setattr(sys, "argv", ["grip_limit.py", track, "--laps", "2"])
        with pytest.raises(SystemExit) as ended:
            grip_limit.main()
        _, lap, contacts = capsys.readouterr().out.splitlines()
        assert ended.value.code == 0
        assert contacts == "wall contacts: 0"
        times.append(float(lap.removeprefix("lap 2: ").removesuffix(" s")))
        # A flying lap is not slower than its own plan by more than some tracking costs.
        driver = grip_limit.grip_limit(load_course(track), load_car("jetracer"))
        plan = float(np.sum(driver.spacing / driver.speed))
        assert plan < times[-1] < 1.12 * plan
    assert times[0] == pytest.approx(times[1], rel=0.05)


def test_the_plan_stays_within_grip_and_motor(grip_limit, tmp_path):
    car = load_car("rx7")
    course = load_course(write_csv(tmp_path / "a.csv", loop(3)(ANGLES[::50]), 0.9, 0.9))
    driver = grip_limit.grip_limit(course, car, 0.8)
    steps = np.roll(driver.line, -1, axis=0) - driver.line
    heading = np.arctan2(*steps.T[::-1])
    turned = np.angle(np.exp(1j * (heading - np.roll(heading, 1))))
    across = driver.speed**2 * np.abs(turned) / driver.spacing
    along = (np.roll(driver.speed, -1) ** 2 - driver.speed**2) / (2 * driver.spacing)
    limit = 0.8 * 9.81 * grip_limit.peak_friction(car.tires.rear)
    assert np.max(across) < limit * 1.001
    assert np.max(across) > limit * 0.9
    assert np.max(np.abs(along)) < limit * 1.02
    assert np.all(np.abs(driver.duty) <= 1)


def test_the_example_says_in_one_line_what_it_cannot_lap(grip_limit, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["grip_limit.py", "straight"])
    with pytest.raises(SystemExit) as ended:
        grip_limit.main()
    assert ended.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("angle", [90.0, 120.0, 135.0])
def test_a_car_that_cuts_a_sharp_corner_does_not_lose_its_place(angle):
    """Its place on the line jumps as it crosses the bisector, by nearly w tan(a / 2)."""
    bend = math.radians(angle)
    course = from_segments(
        "sharp", 1.4, False, [("straight", 6.0, 0.0), ("turn", bend, 0.0), ("straight", 6.0, 0.0)]
    )
    inside = 0.62  # m off the centre line: a car's half width from the inner wall
    turn = np.array([math.cos(bend), math.sin(bend)])
    left = np.array([-turn[1], turn[0]])
    first = np.stack(
        [np.linspace(1.0, 6.0 - inside * math.tan(bend / 2), 200), np.full(200, inside)], 1
    )
    along = np.linspace(inside * math.tan(bend / 2), 5.0, 200)[:, None]
    then = np.array([6.0, 0.0]) + along * turn + inside * left
    xs, ys = np.concatenate([first, then]).T
    found = progress(course, xs, ys, 1.0)
    assert found[-1] == pytest.approx(11.0, abs=1e-6)
    line, place = line_of(course), 1.0
    for x, y in zip(xs, ys, strict=True):
        place = float(line.follow(x, y, place).distance)
    assert place == pytest.approx(11.0, abs=1e-6)


@pytest.mark.parametrize("name", ["box", "ess"])
def test_the_row_of_a_place_is_that_of_whole_numbers_many_laps_on_and_back(name):
    way = way_of(load_course(name))
    places = np.float32(np.arange(-40_000, 40_000) * SPACING)
    index = np.round(places / np.float32(SPACING)).astype(int)
    wanted = index % int(way.whole) if way.whole else np.clip(index, 0, int(way.last))
    np.testing.assert_array_equal(jax.vmap(way.row)(places), wanted)
