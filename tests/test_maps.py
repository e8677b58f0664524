"""Occupancy maps as they come: unknown space, obstacles, edges of the picture, start and goal."""

import logging
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageDraw
from shapely import LineString, MultiLineString

from countersteer.course.course import Course
from countersteer.course.files import load_course
from countersteer.errors import InputError

FREE, UNKNOWN, WALL = 254, 205, 0
RESOLUTION = 0.05
# A ring 160 pixels wide and 110 high round an island of 60 by 40. The origin is below the island.
OUTSIDE, ISLAND = (20, 20, 179, 129), (70, 55, 129, 94)
ORIGIN = (-5.0, -1.9)
WIDTH = 35 * RESOLUTION  # of the corridor below and above the island
Draw = Callable[[ImageDraw.ImageDraw], object]


def ring(*drawn: Draw, beyond: int = UNKNOWN) -> Image.Image:
    """The ring, and what is drawn on it; `beyond` is the shade outside and in the island."""
    image = Image.new("L", (200, 150), beyond)
    draw = ImageDraw.Draw(image)
    draw.rectangle(OUTSIDE, fill=FREE)
    draw.rectangle(ISLAND, fill=beyond)
    for shape in drawn:
        shape(draw)
    return image


def write(folder: Path, image: Image.Image, ending: str = "png", **keys: object) -> str:
    """A map's two files; `keys` of the YAML."""
    image.save(folder / f"map.{ending}")
    about = {
        "image": f"map.{ending}",
        "resolution": RESOLUTION,
        "origin": [*ORIGIN, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    } | keys
    (folder / "map.yaml").write_text("".join(f"{key}: {value}\n" for key, value in about.items()))
    return str(folder / "map.yaml")


def refusal(name: str) -> str:
    with pytest.raises(InputError) as caught:
        load_course(name)
    assert "\n" not in str(caught.value)
    assert name in str(caught.value)
    return str(caught.value)


def apart(course: Course) -> float:
    """Distance of the centre line from the nearest wall (m)."""
    walls = MultiLineString([[w[:2], w[2:]] for w in course.walls])
    return float(LineString(course.line).distance(walls))


def same(one: Course, other: Course) -> bool:
    pairs = [(one.walls, other.walls), (one.line, other.line)]
    return all(np.array_equal(a, b) for a, b in pairs) and one.start == other.start


# Unknown space


@pytest.mark.parametrize("threshold", [0.15, 0.196, 0.2, 0.25, 0.4])
@pytest.mark.parametrize("keys", [{}, {"mode": "trinary"}, {"negate": 1}])
def test_unknown_is_not_free_in_trinary_mode_whatever_the_threshold(threshold, keys, tmp_path):
    image = ring()
    if keys.get("negate"):
        image = Image.fromarray(255 - np.asarray(image))
    course = load_course(write(tmp_path, image, free_thresh=threshold, **keys))
    assert course.closed
    assert course.length == pytest.approx(16.8, abs=0.1)
    assert course.start == pytest.approx((0.0, 0.0, 0.0), abs=RESOLUTION)


def test_the_same_grey_is_nearly_free_in_scale_mode(tmp_path):
    course = load_course(write(tmp_path, ring(), mode="scale", free_thresh=0.2))
    assert not course.closed  # the picture is one free space
    assert len(course.walls) == 4


@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
def test_modes_and_formats_of_pictures_make_the_same_course(mode, tmp_path):
    image = ring()
    plain = load_course(write(tmp_path, image))
    shades = np.asarray(image)
    if mode == "raw":  # per cent; 255 is unknown
        shades = np.where(shades == FREE, 0, 255).astype(np.uint8)
    if mode == "scale":
        shades = np.where(shades == FREE, 254, 0).astype(np.uint8)
    picture = Image.fromarray(shades)
    for ending in ("png", "pgm", "bmp"):
        assert same(plain, load_course(write(tmp_path, picture, ending, mode=mode)))
    # A PGM in characters, with a comment, as some map savers write.
    name = write(tmp_path, picture, "pgm", mode=mode)
    rows = "\n".join(" ".join(map(str, row)) for row in shades)
    (tmp_path / "map.pgm").write_text(f"P2\n# CREATOR: a map saver\n200 150\n255\n{rows}\n")
    assert same(plain, load_course(name))


# Obstacles


OBSTACLES: dict[str, list[Draw]] = {
    "box": [lambda d: d.rectangle((95, 100, 99, 104), fill=WALL)],
    "disc": [lambda d: d.ellipse((140, 100, 152, 112), fill=WALL)],
    "triangle": [lambda d: d.polygon([(150, 60), (160, 65), (152, 75)], fill=WALL)],
    "barrier": [lambda d: d.rectangle((60, 40, 140, 41), fill=WALL)],
    "unknown": [lambda d: d.rectangle((40, 70, 52, 80), fill=UNKNOWN)],
    "hollow": [lambda d: d.rectangle((30, 30, 44, 44), outline=WALL, width=2)],
}
OBSTACLES["all at once"] = [shape for shapes in OBSTACLES.values() for shape in shapes]


@pytest.mark.parametrize("name", OBSTACLES)
def test_obstacles_on_a_ring_are_walls_and_the_lap_stays(name, tmp_path):
    plain = load_course(write(tmp_path, ring()))
    course = load_course(write(tmp_path, ring(*OBSTACLES[name])))
    assert course.closed
    assert course.goal_distance == course.length == pytest.approx(plain.length, rel=0.3)
    assert len(course.walls) >= len(plain.walls) + 3
    # The line passes an obstacle on its wider side, and the room beside it is that to the obstacle.
    assert apart(course) > 0.3
    assert np.min(course.sides) == pytest.approx(apart(course), abs=2 * RESOLUTION)


def test_what_touches_a_wall_is_part_of_it(tmp_path):
    shapes = [
        lambda d: d.rectangle((95, 110, 110, 129), fill=WALL),
        lambda d: d.rectangle((60, 70, 70, 75), fill=WALL),
        lambda d: d.line((129, 94, 140, 105), fill=WALL),  # at a corner only
    ]
    course = load_course(write(tmp_path, ring(*shapes)))
    assert course.closed
    assert apart(course) > 0.3


def test_a_ring_that_is_blocked_is_no_lap(tmp_path):
    course = load_course(write(tmp_path, ring(lambda d: d.rectangle((90, 94, 91, 129), fill=WALL))))
    assert not course.closed


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ((50, 55, 120, 94), (150, 55, 220, 94)),  # as large
        ((50, 50, 190, 99), (221, 50, 255, 99)),  # smaller, but wider than the way
    ],
)
def test_two_islands_are_no_ring(first, second, tmp_path):
    image = Image.new("L", (300, 150), UNKNOWN)
    draw = ImageDraw.Draw(image)
    draw.rectangle((20, 20, 279, 129), fill=FREE)
    draw.rectangle(first, fill=UNKNOWN)
    draw.rectangle(second, fill=UNKNOWN)
    assert not load_course(write(tmp_path, image, origin=[-3.0, -1.9, 0])).closed


# Edges


def page(margin: int) -> Image.Image:
    """A track that is drawn in black on a white page."""
    image = Image.new("L", (160 + 2 * margin, 120 + 2 * margin), 255)
    draw = ImageDraw.Draw(image)
    box = np.array([0, 0, 159, 119]) + margin
    draw.rectangle(tuple(box), outline=WALL, width=3)
    draw.rectangle((margin + 55, margin + 45, margin + 104, margin + 74), fill=WALL)
    return image


@pytest.mark.parametrize("margin", [1, 15, 60])
def test_free_space_that_reaches_the_pictures_edge_is_warned_of(margin, tmp_path, caplog):
    name = write(tmp_path, page(margin), origin=[0, 0, 0])
    load_course(name)
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert "the free space at the origin reaches the picture's edge" in record.getMessage()
    assert name in record.getMessage()
    caplog.clear()
    middle = (margin + 30) * RESOLUTION
    course = load_course(
        write(tmp_path, page(margin), origin=[0, 0, 0], start=f"{{x_m: {middle}, y_m: {middle}}}")
    )
    assert not caplog.records
    assert course.closed
    assert np.min(course.walls) > margin * RESOLUTION  # the ring is that within the drawing
    assert apart(course) > 0.6


def test_a_ring_in_unknown_space_is_not_warned_of(tmp_path, caplog):
    load_course(write(tmp_path, ring()))
    assert not caplog.records


# Start and goal


@pytest.mark.parametrize(("heading", "length"), [(-80.0, 6.7), (100.0, 10.1)])
def test_start_and_goal_of_a_lap_are_those_of_the_file(heading, length, tmp_path):
    start = f"{{x_m: 3.0, y_m: 1.0, heading_deg: {heading}}}"
    name = write(tmp_path, ring(), start=start, goal="{x_m: -3.5, y_m: 1.0}")
    course = load_course(name)
    assert course.start == (3.0, 1.0, math.radians(heading))
    assert course.goal_distance == pytest.approx(length, abs=0.2)
    ahead = course.line[1] - course.line[0]
    assert ahead @ [math.cos(course.start[2]), math.sin(course.start[2])] > 0
    assert math.dist(course.line[0], (3.0, 1.0)) < 0.3


def test_a_start_without_a_heading_looks_along_the_lap(tmp_path):
    course = load_course(write(tmp_path, ring(), start="{x_m: 1.0, y_m: 3.5}"))
    assert course.start == pytest.approx((1.0, 3.5, 0.0), abs=0.05)
    back = load_course(write(tmp_path, ring(), start="{x_m: 1.0, y_m: 3.5}", reverse="true"))
    assert math.cos(back.start[2]) == pytest.approx(-1.0, abs=0.01)


def rooms() -> Image.Image:
    """Four rooms: doors lead from the first to the second, on to the fourth and to the third."""
    image = Image.new("L", (300, 200), UNKNOWN)
    draw = ImageDraw.Draw(image)
    for box in ((10, 10, 120, 90), (130, 10, 290, 90), (10, 100, 200, 190), (210, 100, 290, 190)):
        draw.rectangle(box, fill=FREE)
    for door in ((120, 40, 130, 60), (230, 90, 250, 100), (200, 140, 210, 160)):
        draw.rectangle(door, fill=FREE)
    return image


def test_a_goal_in_other_rooms_is_led_to_through_the_doors(tmp_path):
    keys = {"origin": [-2, -8, 0]}
    free = load_course(write(tmp_path, rooms(), **keys))
    assert free.width is None
    assert free.goal_distance is None
    course = load_course(write(tmp_path, rooms(), **keys, goal="{x_m: -0.5, y_m: -6.0}"))
    assert np.array_equal(course.walls, free.walls)
    assert not course.closed
    assert course.goal_distance == course.length
    assert course.line[0] == pytest.approx((0.0, 0.0))
    assert course.line[-1] == pytest.approx((-0.5, -6.0))
    assert course.start[2] == math.atan2(*(course.line[1] - course.line[0])[::-1])
    for door in ((4.25, -0.5), (10.0, -2.75), (8.25, -5.5)):
        assert np.min(np.hypot(*(course.line - door).T)) < 0.3
    assert apart(course) > 0.4
    assert np.min(course.sides) == pytest.approx(apart(course), abs=RESOLUTION)


def test_a_way_leads_through_no_wall_however_thin(tmp_path):
    image = Image.new("L", (1200, 600), FREE)
    draw = ImageDraw.Draw(image)
    draw.rectangle((0, 0, 1199, 599), outline=WALL, width=3)
    draw.line((100, 0, 500, 400), fill=WALL)  # pixels that meet at corners only
    draw.line((800, 200, 801, 599), fill=WALL)
    keys = {"origin": [-2, -2, 0], "goal": "{x_m: 56.0, y_m: 0.0}"}
    course = load_course(write(tmp_path, image, **keys))
    assert apart(course) > 1.0


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"start": "{x_m: 0, y_m: 2}"}, "start: (0, 2) is not free"),
        ({"start": "{x_m: 1e3}"}, "start: (1000, 0) is not free"),
        ({"start": "{x: 1}"}, "unknown key start.x; did you mean start.x_m?"),
        ({"start": "[1, 2, 3]"}, "start must be a table"),
        ({"start": "{x_m: .nan}"}, "start.x_m must be a number in"),
        ({"start": "{heading_deg: north}"}, "start.heading_deg must be a number in"),
        ({"start": "{heading_deg: 0}", "reverse": "true"}, "either reverse or start.heading_deg"),
        ({"goal": "{x_m: 1, heading_deg: 3}"}, "unknown key goal.heading_deg"),
    ],
)
def test_a_wrong_start_or_goal_is_refused(keys, says, tmp_path):
    assert says in refusal(write(tmp_path, ring(), **keys))


@pytest.mark.parametrize("goal", ["{x_m: 11, y_m: -9}", "{x_m: 4.2, y_m: 1}", "{}"])
def test_a_goal_that_cannot_be_reached_is_refused(goal, tmp_path):
    name = write(tmp_path, rooms(), origin=[-2, -8, 0], goal=goal)
    assert "goal: no free way leads from the start to it" in refusal(name)
