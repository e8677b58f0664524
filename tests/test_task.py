"""The judge: one for every driver, every batch and every log."""

import dataclasses
import math
from pathlib import Path

import jax
import numpy as np
import pytest

from conftest import STEADY, driven, judged, write_run
from countersteer.batch.population import draw, load_population
from countersteer.car.files import load_car
from countersteer.course.course import Course, Turn, from_segments
from countersteer.course.files import load_course
from countersteer.drivers.drift_turn import drift_turn
from countersteer.drivers.replay import Replay
from countersteer.judge_run import judge_run, samples_of
from countersteer.runs.files import Table
from countersteer.runs.importers.dart import import_dart
from countersteer.runs.run import read_run
from countersteer.signals import Command, Motion, Wheels
from countersteer.task import turns
from countersteer.task.judge import Outcome, Sample, Task, summary

CAR = load_car("rx7")
DATA = Path(__file__).parents[2] / "shared" / "data" / "dart"
RIGHT = from_segments(
    "corner",
    1.4,
    False,
    [("straight", 4.0, 0.0), ("turn", -math.pi / 2, 0.0), ("straight", 4.0, 0.0)],
    goal=7.0,
)
ZERO = np.zeros(1)


def path(course, speed, points, slip=(), time=6.0):
    """Samples of a car that follows the centre line at a speed, `points` (s, °) of heading.

    `slip` (s, °) is the sideslip; a speed below 0 goes backwards along the line.
    """
    t = np.arange(0, time, 0.005)
    v = np.interp(t, *np.transpose(speed)) if np.ndim(speed) else np.full(len(t), float(speed))
    along = course.start_distance + np.concatenate([[0.0], np.cumsum(0.005 * np.abs(v))])[:-1]
    x, y = (np.interp(along, course.marks, course.line[:, i]) for i in (0, 1))
    heading = np.radians(np.interp(t, *np.transpose(points)))
    beta = np.radians(np.interp(t, *np.transpose(slip))) if len(slip) else 0.0 * t
    rate, none = np.gradient(heading, 0.005), 0.0 * t
    motion = Motion(
        x, y, heading, v * np.cos(beta), v * np.sin(beta), rate, Wheels(*[none] * 4), *[none] * 5
    )
    return Sample(t, motion, none, none, none)


def judge(course, samples):
    task = Task.of(course)
    score, _ = task.follow(task.init(), samples)
    return score, turns.results(score.turns, score.handover, float(score.time))


# Into the corner point at 2 s, from 0.2 s before it; 25° too far, and back by 2.9 s.
CLEAN = [(0, 0), (1.8, 0), (2.2, -90), (2.5, -115), (2.9, -90), (6, -90)]


def test_a_turn_is_measured_where_the_definition_says():
    speed = [(0, 2.0), (1.0, 2.0), (3.0, 2.4), (6.0, 2.4)]
    _, (turn,) = judge(RIGHT, path(RIGHT, speed, CLEAN, [(2.0, 0), (2.3, 40), (2.8, 0)]))
    begin = 1.8 + 0.4 * 15 / 90
    assert turn.begin_s == pytest.approx(begin, abs=0.006)
    assert turn.end_s == pytest.approx(2.9 + 0.05, abs=0.011)
    assert turn.heading_overshoot_deg == pytest.approx(25, abs=0.5)
    assert turn.heading_error_deg == pytest.approx(0, abs=0.5)
    assert turn.peak_sideslip_deg == pytest.approx(40, abs=0.8)
    assert turn.peak_yaw_rate_degps == pytest.approx(90 / 0.4, abs=4)
    entry = np.interp(begin, [1.0, 3.0], [2.0, 2.4])
    before = entry - 0.2 * 0.5 / entry  # 0.5 m before, at 0.2 m/s²
    assert turn.entry_speed_mps == pytest.approx(before, abs=0.005)
    assert turn.handover_s is None


def test_left_and_right_are_judged_alike():
    left = from_segments(
        "left", 1.4, False,
        [("straight", 4.0, 0.0), ("turn", math.pi / 2, 0.0), ("straight", 4.0, 0.0)], goal=7.0,
    )  # fmt: skip
    slip = [(2.0, 0), (2.3, 40), (2.8, 0)]
    _, (one,) = judge(RIGHT, path(RIGHT, 2.0, CLEAN, slip))
    mirrored = [(t, -h) for t, h in CLEAN]
    _, (other,) = judge(left, path(left, 2.0, mirrored, [(t, -s) for t, s in slip]))
    assert dataclasses.asdict(one) == pytest.approx(
        dataclasses.asdict(other) | {"heading_error_deg": -other.heading_error_deg}, abs=1e-9
    )


@pytest.mark.parametrize("hand", [1, -1])
def test_a_spin_on_the_straight_is_no_turn(hand):
    """All of it 2.2 m and more before the corner, which is 4 m after the start."""
    spun = 360 * hand
    points = [(0, 0), (0.3, 0), (0.9, spun), *((t, spun + h) for t, h in CLEAN[1:])]
    _, (turn,) = judge(RIGHT, path(RIGHT, 2.0, points))
    _, (clean,) = judge(RIGHT, path(RIGHT, 2.0, CLEAN))
    assert dataclasses.asdict(turn) == pytest.approx(dataclasses.asdict(clean), abs=1e-9)


def test_a_spin_the_wrong_way_near_the_corner_is_no_turn_either():
    points = [(0, 0), (1.2, 0), (1.7, 360), *((t, 360 + h) for t, h in CLEAN[1:])]
    _, (turn,) = judge(RIGHT, path(RIGHT, 2.0, points))
    _, (clean,) = judge(RIGHT, path(RIGHT, 2.0, CLEAN))
    assert turn.begin_s == pytest.approx(clean.begin_s)
    assert turn.heading_overshoot_deg == pytest.approx(clean.heading_overshoot_deg)


def test_a_spin_before_another_corner_does_not_count_for_this_one():
    """Two corners: what is run up near the first is no turn of the second."""
    two = from_segments(
        "two", 1.4, False,
        [("straight", 4.0, 0.0), ("turn", -math.pi / 2, 0.0), ("straight", 6.0, 0.0),
         ("turn", -math.pi / 2, 0.0), ("straight", 3.0, 0.0)],
    )  # fmt: skip
    clean = [*CLEAN[:-1], (4.8, -90), (5.2, -180), (8, -180)]
    spun = [(0, 0), (1.8, 0), (2.6, -450), (4.8, -450), (5.2, -540), (8, -540)]
    _, (_, second) = judge(two, path(two, 2.0, clean, time=7.0))
    _, (first, after) = judge(two, path(two, 2.0, spun, time=7.0))
    assert first.heading_overshoot_deg == pytest.approx(360, abs=1)
    assert first.heading_error_deg == pytest.approx(0, abs=1e-6)
    assert dataclasses.asdict(after) == pytest.approx(dataclasses.asdict(second), abs=1e-6)


def test_what_goes_too_far_in_one_turn_is_not_into_the_next():
    """Half way to the next corner, of the same hand, the car is still 50° too far."""
    two = from_segments(
        "two", 1.4, False,
        [("straight", 4.0, 0.0), ("turn", -math.pi / 2, 0.0), ("straight", 2.0, 0.0),
         ("turn", -math.pi / 2, 0.0), ("straight", 3.0, 0.0)],
    )  # fmt: skip
    points = [
        (0, 0),
        (1.8, 0),
        (2.2, -140),
        (2.55, -140),
        (2.7, -90),
        (2.9, -90),
        (3.1, -180),
        (6, -180),
    ]
    _, (first, second) = judge(two, path(two, 2.0, points, [(2.0, 0), (2.2, 40), (2.7, 0)], 4.4))
    assert first.heading_overshoot_deg == pytest.approx(50, abs=0.5)
    assert first.heading_error_deg == pytest.approx(0, abs=0.5)
    assert second.begin_s == pytest.approx(2.9 + 0.2 * 15 / 90, abs=0.006)
    assert second.heading_error_deg == pytest.approx(0, abs=0.5)


@pytest.mark.parametrize("gap", [1.0, 2.0, 3.0])
def test_two_corners_of_one_hand_in_one_slide_are_two_turns(gap):
    """A U in a single drift: the nose is into the second corner while the first is still near."""
    u = from_segments(
        "u", 1.4, False,
        [("straight", 4.0, 0.0), ("turn", math.pi / 2, 0.0), ("straight", gap, 0.0),
         ("turn", math.pi / 2, 0.0), ("straight", 4.0, 0.0)],
    )  # fmt: skip
    after = 1.8 + (gap + 0.8) / 2
    points = [(0, 0), (1.8, 0), (after, 180), (9, 180)]
    slip = [(1.8, 0), (2.0, -40), (after, -40), (after + 0.2, 0)]
    _, (first, second) = judge(u, path(u, 2.0, points, slip, time=3.6 + gap / 2))
    assert first.end_s == pytest.approx(second.begin_s)
    assert first.peak_sideslip_deg == pytest.approx(40, abs=1)
    assert second.peak_sideslip_deg == pytest.approx(40, abs=1)
    assert second.heading_error_deg == pytest.approx(0, abs=0.5)
    assert second.heading_overshoot_deg == pytest.approx(0, abs=0.5)


@pytest.mark.parametrize("turned", [-0.5, 0.3])
def test_a_car_that_starts_turned_is_judged_by_the_corridor(turned):
    """`[start] heading_deg` is the car's, not the course's."""
    x, y, heading = RIGHT.start
    askew = dataclasses.replace(RIGHT, start=(x, y, heading + turned))
    points = [(0, math.degrees(turned)), (0.4, 0), *CLEAN[1:]]
    _, (turn,) = judge(askew, path(askew, 2.0, points))
    _, (clean,) = judge(RIGHT, path(RIGHT, 2.0, CLEAN))
    assert dataclasses.asdict(turn) == pytest.approx(dataclasses.asdict(clean), abs=1e-9)


def test_corners_of_rounded_courses_have_the_bearings_of_their_straights():
    course = load_course("bends")
    corners = turns.corners_of(course, 1, float)
    bearing = course.start[2]
    for corner, before in zip(course.turns_ahead(1), corners.before, strict=True):
        assert math.remainder(before - bearing, 2 * math.pi) == pytest.approx(0, abs=1e-9)
        bearing += corner.angle


def test_the_speed_of_entry_is_that_of_the_last_time_the_car_came_by():
    """To 0.2 m before the corner at 2 m/s, back by 1 m, and on at 0.8 m/s."""
    v = [(0, 2.0), (1.0, 2.0), (1.9, 2.0), (1.91, -2.0), (2.4, -2.0), (2.41, 0.8), (9, 0.8)]
    time = np.arange(0, 5, 0.005)
    along = np.cumsum(0.005 * np.interp(time, *np.transpose(v)))
    corner = float(time[np.argmax((time > 2.5) & (along > 3.9))])
    samples = path(RIGHT, v, [(0, 0), (corner, 0), (corner + 0.5, -90), (9, -90)], time=5)
    x, y = (np.interp(along, RIGHT.marks, RIGHT.line[:, i]) for i in (0, 1))
    samples = samples._replace(motion=samples.motion._replace(x=x, y=y))
    _, (turn,) = judge(RIGHT, samples)
    assert turn.entry_speed_mps == pytest.approx(0.8, abs=0.01)


def test_turns_of_a_slalom_are_linked():
    """The other hand begins while the first has not ended, and ends it."""
    ess = from_segments(
        "slalom", 1.4, False,
        [("straight", 4.0, 0.0), ("turn", -math.pi / 3, 0.0), ("straight", 1.0, 0.0),
         ("turn", math.pi / 3, 0.0), ("straight", 3.0, 0.0)],
    )  # fmt: skip
    points = [(0, 0), (1.8, 0), (2.2, -75), (2.6, 20), (2.8, 0), (6, 0)]
    _, (first, second) = judge(ess, path(ess, 2.0, points, time=3.9))
    assert first.end_s == pytest.approx(second.begin_s)
    assert first.heading_overshoot_deg == pytest.approx(15, abs=0.6)
    assert second.heading_overshoot_deg == pytest.approx(20, abs=0.6)
    assert second.heading_error_deg == pytest.approx(0, abs=0.5)


def test_a_reversing_car_has_no_sideslip():
    """All of the corner backwards: nose away from where it goes, which is no drift of 180°."""
    points = [(t, h) for t, h in CLEAN]
    score, (turn,) = judge(RIGHT, path(RIGHT, -2.0, points, [(2.0, 0), (2.3, 40), (2.8, 0)]))
    assert turn.peak_sideslip_deg == 0
    assert turn.heading_error_deg == pytest.approx(0, abs=0.5)
    assert turn.entry_speed_mps == pytest.approx(2.0, abs=1e-6)
    assert turn.duration_s == pytest.approx(2.0, abs=0.006)  # backwards is not straight on
    assert Outcome.of(score.outcome) == Outcome.REACHED


def test_a_car_that_slows_down_in_its_slide_has_not_ended_its_turn():
    """At 0.4 m/s, where the heading comes back: sideslip counts for nothing, but it is there."""
    speed = [(0, 2.0), (1.8, 2.0), (2.3, 0.4), (2.7, 0.4), (3.2, 1.5), (6, 1.5)]
    points = [(0, 0), (1.8, 0), (2.2, -90), (2.4, -115), (2.6, -115), (2.9, -90), (6, -90)]
    _, (turn,) = judge(RIGHT, path(RIGHT, speed, points, [(2.0, 0), (2.2, 40), (2.7, 40), (3, 0)]))
    assert turn.heading_error_deg == pytest.approx(0, abs=0.5)
    assert turn.end_s > 2.9


def test_a_car_that_creeps_has_no_sideslip_and_stalls_only_where_it_stands():
    """At 0.3 m/s a lateral speed of 0.2 m/s is noise, not a drift of 34°."""
    points = [(0, 0), (12.7, 0), (14, -90), (40, -90)]
    samples = path(RIGHT, 0.36, points, [(0, 34), (40, 34)], time=24.0)
    score, (turn,) = judge(RIGHT, samples)
    assert turn.peak_sideslip_deg == 0
    assert turn.heading_error_deg == pytest.approx(0, abs=0.5)
    assert Outcome.of(score.outcome) == Outcome.REACHED
    still = path(RIGHT, [(0, 1.0), (2, 0.0), (20, 0.0)], [(0, 0), (20, 0)], time=12.0)
    score, found = judge(RIGHT, still)
    assert not found
    assert Outcome.of(score.outcome) == Outcome.STALLED
    assert float(score.time) == pytest.approx(7, abs=0.3)


def test_a_turn_that_never_settles_ends_after_two_seconds():
    spins = [(0, 0), (1.8, 0), (5.8, -90 - 3 * 360), (6, -90 - 3 * 360)]
    _, (turn,) = judge(RIGHT, path(RIGHT, [(0, 2), (2, 2), (2.2, 0.6), (6, 0.6)], spins))
    assert turn.duration_s == pytest.approx(2.0, abs=0.006)
    assert abs(turn.heading_error_deg) <= 180


def by_definition(course, record):
    """The turns straight from the definition, in NumPy: no scan, no zones, no slots."""
    every = slice(0, None, 5)
    time, m = 0.001 * record.tick[every], jax.tree.map(lambda leaf: leaf[every], record.motion)
    speed, rate = np.hypot(m.vx, m.vy), np.abs(m.yaw_rate)
    slip = np.where((speed > 0.5) & (m.vx > 0), np.abs(np.arctan2(m.vy, m.vx)), 0.0)
    aside = np.where(speed > 0.2, np.abs(np.arctan2(m.vy, m.vx)), 0.0)
    calm = (rate < math.radians(30)) & (aside < math.radians(10))
    from countersteer.course.course import progress

    along = progress(course, m.x, m.y, course.start_distance)
    found, first, bearing = [], 0, course.start[2]
    for corner in course.turns_ahead(1):
        hand = math.copysign(1, corner.angle)
        into = hand * (m.heading[first:] - bearing) >= math.radians(15)
        if not into.any():
            break
        begin = first + int(np.argmax(into))
        bearing += corner.angle
        last = min(int(np.searchsorted(time, time[begin] + 2 - 1e-9)), len(time) - 1)
        stirred = begin + int(np.argmax(~calm[begin:]))
        quiet = [i for i in range(stirred + 10, last + 1) if calm[i - 9 : i + 1].all()]
        end = quiet[0] if quiet else last
        during = slice(begin, end + 1)
        off = m.heading[during] - bearing
        where = int(np.argmax(along >= along[begin] - 0.5))
        error, beyond = math.remainder(off[-1], 2 * math.pi), max(0.0, (hand * off).max())
        peaks = slip[during].max(), rate[during].max()
        found.append((time[begin], time[end], speed[where], *peaks, error, beyond))
        first = end
    return np.array(found)


@pytest.mark.parametrize("name", ["box", "ess"])
def test_the_judge_finds_what_the_definition_says_on_drives_of_random_cars(name):
    course, seeds = load_course(name), range(40, 44)
    drawn = draw(load_population("around"), CAR, course, seeds, np.float64)
    for i in range(len(seeds)):
        one, floor = jax.tree.map(lambda leaf, i=i: leaf[i], (drawn.cars, drawn.floor))
        record = driven(
            course, one, drift_turn(course, CAR), 12.0, nominal=CAR, seed=seeds[i], floor=floor,
            charge=float(drawn.charge[i]), start=tuple(map(float, drawn.pose[i])),
        )  # fmt: skip
        expected = by_definition(course, record)
        score, found = judged(course, record)
        expected = expected[expected[:, 1] <= float(score.time) + 1e-6]
        rows = []
        for turn in found[: len(expected)]:
            peaks = turn.peak_sideslip_deg, turn.peak_yaw_rate_degps
            angles = (*peaks, turn.heading_error_deg, turn.heading_overshoot_deg)
            rows.append((turn.begin_s, turn.end_s, turn.entry_speed_mps, *np.radians(angles)))
            assert turn.handover_s is not None
            assert 0 < turn.begin_s - turn.handover_s < 0.4
        assert len(found) == 4
        within = np.array([1e-6, 1e-6, 0.03, *[1e-6] * 4])  # the speed between two samples
        assert np.all(np.abs(np.array(rows) - expected) <= within)


def test_a_run_s_folder_is_judged_as_the_drive_that_made_it(tmp_path):
    course = load_course("box")
    (tmp_path / "run").mkdir()
    run = write_run(tmp_path / "run", course, CAR, drift_turn(course, CAR), 12.0)
    _, told = judge_run(run, course)
    assert len(told["turns"]) == 4
    for one, other in zip(told["turns"], run.summary["turns"], strict=True):
        del one["handover_s"], other["handover_s"]  # a log does not tell
        assert one == pytest.approx(other, abs=1e-6)
    assert told | {"turns": []} == run.summary | {"turns": []}


def test_a_log_may_rest_have_gaps_and_empty_poses(tmp_path):
    """As logs of real cars do; a simulated drive may do none of it."""
    course = load_course("box")
    (tmp_path / "run").mkdir()
    driver = drift_turn(course, CAR, None, 1, *STEADY)
    run = write_run(tmp_path / "run", course, CAR, driver, 12.0)
    _, told = judge_run(run, course)
    poses = Table({n: run.truth[n][::2].copy() for n in ("time_s", "x_m", "y_m", "heading_rad")})
    poses["heading_rad"] = np.arctan2(np.sin(poses["heading_rad"]), np.cos(poses["heading_rad"]))
    poses["heading_rad"][40] = poses["x_m"][90] = np.nan
    rest = np.arange(0, 7.0, 0.01)
    late = {n: np.concatenate([np.full(len(rest), c[0]), c]) for n, c in poses.items()}
    late["time_s"] = np.concatenate([rest, 7.0 + poses["time_s"]])
    gap = (late["time_s"] < 7.0 + 2.6) | (late["time_s"] > 7.0 + 2.9)
    late = Table({n: c[gap] for n, c in late.items()})
    _, found = judge_run(dataclasses.replace(run, truth=late, telemetry=None), course)
    assert found["outcome"] == "goal reached"
    for one, other in zip(found["turns"], told["turns"], strict=True):
        assert one["begin_s"] == pytest.approx(other["begin_s"] + 7.0, abs=0.02)
        assert one["heading_error_deg"] == pytest.approx(other["heading_error_deg"], abs=1.5)
        assert one["peak_sideslip_deg"] == pytest.approx(other["peak_sideslip_deg"], abs=1.5)


def test_a_sample_that_is_no_number_ends_a_drive_and_spoils_no_turn():
    samples = path(RIGHT, 2.0, CLEAN)
    vx = samples.motion.vx.copy()
    vx[420:] = np.nan
    score, (turn,) = judge(RIGHT, samples._replace(motion=samples.motion._replace(vx=vx)))
    assert Outcome.of(score.outcome) == Outcome.LOST
    told = dataclasses.asdict(turn)
    assert all(np.isfinite(value) for value in told.values() if value is not None)


def test_without_a_course_a_drive_is_done_when_it_is_over(tmp_path):
    driver = Replay(times=np.zeros(1), commands=Command(np.array([0.5]), np.zeros(1)))
    (tmp_path / "run").mkdir()
    run = write_run(tmp_path / "run", None, CAR, driver, 1.0)
    _, told = judge_run(run, None)
    assert told == run.summary == summary(judge_run(run, None)[0], Outcome.DONE)
    assert told["outcome"] == "done"
    assert told["turns"] == []


@pytest.mark.skipif(not DATA.is_dir(), reason="the real logs are not here")
def test_a_real_log_is_judged_by_its_motion_capture(tmp_path):
    """The drift log's first slide, with a corner laid where the car turned by itself."""
    (log,) = (DATA / "drift_tape_and_tiles").glob("*.csv")
    run = read_run(Path(import_dart(log, tmp_path)["run"]))
    samples = samples_of(run)
    m, time = samples.motion, samples.time
    fast = np.hypot(m.vx, m.vy) > 0.5
    turned = np.nonzero(fast & (np.abs(m.yaw_rate) > 2))[0]
    begin = int(turned[0])
    before = begin - int(np.argmax(np.abs(m.yaw_rate[begin::-1]) < 0.2))
    bearing = float(m.heading[before])
    hand = float(np.sign(m.yaw_rate[begin]))
    ahead = np.array([math.cos(bearing), math.sin(bearing)])
    aside = hand * np.array([-ahead[1], ahead[0]])
    here = np.array([m.x[before], m.y[before]])
    line = np.array([here, here + 2.0 * ahead, here + 2.0 * ahead + 2.0 * aside])
    course = Course(
        "laid", 4.0, False, line, np.zeros((0, 4)), (Turn(2.0, hand * math.pi / 2),),
        (*here, bearing), 0.0, 4.0,
    )  # fmt: skip
    cut = jax.tree.map(lambda leaf: leaf[before:], samples)
    _, (turn, *_) = judge(course, cut)
    into = hand * (m.heading[before:] - bearing)
    first = int(np.argmax(into >= math.radians(15)))
    assert turn.begin_s == pytest.approx(time[before + first])
    assert turn.duration_s <= 2.0 + 1e-6
    during = slice(before + first, before + first + round(turn.duration_s / 0.005) + 1)
    forward = (m.vx[during] > 0) & (np.hypot(m.vx, m.vy)[during] > 0.5)
    slip = np.degrees(np.abs(np.arctan2(m.vy, m.vx)))[during][forward].max()
    assert turn.peak_sideslip_deg == pytest.approx(slip, abs=1e-3)
    assert turn.peak_sideslip_deg > 25
    beyond = np.degrees((hand * (m.heading - bearing))[during]).max() - 90
    assert turn.heading_overshoot_deg == pytest.approx(beyond, abs=1e-3)
