"""Lidar and place from outside in the filters, and what looks on at trials."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from countersteer.batch.population import draw, load_population
from countersteer.batch.trials import run_trials
from countersteer.car.files import load_car
from countersteer.course.course import from_segments
from countersteer.course.files import load_course
from countersteer.course.position import beyond_corner, legs_of
from countersteer.drivers.drift_turn import drift_turn
from countersteer.estimation import lidar_walls
from countersteer.estimation.estimate import Estimate
from countersteer.estimation.kalman import diagonal
from countersteer.estimation.wall_angle import wall_angle
from countersteer.pilot import Pilot
from countersteer.sensing import lidar
from countersteer.signals import Reading
from countersteer.simulator import Simulator, scan
from countersteer.task.judge import Outcome
from countersteer.world.walls import padded
from studies.watches import Errors

WIDTH = 1.4
SCANNER = load_car("rx7", ("sensors.lidar.beams=72",)).sensors.lidar


def scanned(course, pose):
    walls = jnp.asarray(padded(course.walls, np.dtype(np.float64)))
    return lidar.ranges(SCANNER, walls, pose, np.zeros(SCANNER.beams))


@pytest.mark.parametrize("angle", [-0.3, 0.0, 0.2])
@pytest.mark.parametrize("offset", [-0.2, 0.1])
def test_a_lidar_tells_offset_and_angle_to_the_corridor(offset, angle):
    course = from_segments("long", WIDTH, False, [("straight", 20.0, 0.0)])
    ranges = scanned(course, (9.0, offset, angle))
    mean, covariance = (0.0, angle - 0.05, 0.0), diagonal([0.3, 0.1, 0.01])
    for _ in range(3):
        mean, covariance, taken = lidar_walls.line_up(
            SCANNER, WIDTH, mean, covariance, ranges, jnp.asarray(True), 4.0
        )
        assert taken
    assert float(mean[0]) == pytest.approx(offset, abs=0.01)
    assert float(mean[1]) == pytest.approx(angle, abs=0.01)


@pytest.mark.parametrize("turn", [math.radians(t) for t in (-120, -90, -60, 60, 90, 120)])
@pytest.mark.parametrize("offset", [-0.2, 0.1])
def test_a_lidar_tells_how_far_the_corner_is(turn, offset):
    parts = [("straight", 5.0, 0.0), ("turn", turn, 0.0), ("straight", 5.0, 0.0)]
    course = from_segments("bend", WIDTH, False, parts)
    error = 0.1
    ranges = scanned(course, (3.5, offset, error))
    told, sees = lidar_walls.corner_ahead(SCANNER, WIDTH, ranges, error, offset, turn)
    assert sees
    assert float(told) == pytest.approx(1.5, abs=0.02)


def test_a_place_before_a_corner_is_the_same_place_behind_it():
    legs, rng = legs_of(load_course("ess"), 1), np.random.default_rng(0)
    bearing = legs.bearing
    for leg in range(3):
        for x, y in rng.uniform(-2, 8, (5, 2)):
            before, behind = (legs.seen(at, x, y, 0.0) for at in (leg, leg + 1))
            angle = bearing[leg + 1] - bearing[leg]
            ahead, aside = beyond_corner(before.distance, before.offset, angle)
            dx, dy = legs.x[leg + 1] - legs.x[leg], legs.y[leg + 1] - legs.y[leg]
            gap = math.cos(bearing[leg + 1]) * dx + math.sin(bearing[leg + 1]) * dy
            assert float(gap + ahead) == pytest.approx(float(behind.distance), abs=1e-9)
            assert float(aside) == pytest.approx(float(behind.offset), abs=1e-9)


@pytest.mark.parametrize("hand", [-1, 1])
def test_a_lidar_finds_its_corridor_behind_a_corner(hand):
    """A turn from 1 m before the corner. A beam may end on either wall of either corridor."""
    turn = hand * math.pi / 2
    parts = [("straight", 5.0, 0.0), ("turn", turn, 0.0), ("straight", 5.0, 0.0)]
    course = from_segments("bend", WIDTH, False, parts)
    filter_ = wall_angle(load_car("rx7", ("sensors.lidar.beams=72",)), WIDTH)
    part = np.linspace(0, 1, 81)
    heading = turn * np.sin(np.minimum(1, 1.3 * part) * math.pi / 2)
    x, y = 4.0 + 1.3 * np.sin(part * math.pi / 2), hand * (-0.1 + 1.6 * part**2)
    vx, vy = np.gradient(x) / 0.0125, np.gradient(y) / 0.0125
    cosine, sine = np.cos(heading), np.sin(heading)
    ages, sonar = (math.inf,) * 3, (Reading(0.0, 0),) * 3

    @jax.jit
    def update(memory, estimate, time, pose):
        scan = Reading(scanned(course, pose), 0)
        return filter_.update(memory, sonar, ages, estimate, time, scan, 0.0)

    start = filter_.initial_memory(-0.1 * hand)
    places = {}
    for name, offset in {
        "known": beyond_corner(1.0, -0.1 * hand, turn)[1] + 0.1,
        "unknown": None,
    }.items():
        memory = filter_.turned(start, turn, 0.03, offset)
        for i in range(1, len(part)):
            estimate = Estimate(
                x=x[i],
                y=y[i],
                heading=heading[i],
                vx=cosine[i] * vx[i] + sine[i] * vy[i],
                vy=cosine[i] * vy[i] - sine[i] * vx[i],
                yaw_rate=(heading[i] - heading[i - 1]) / 0.0125,
            )
            memory = update(memory, estimate, 0.0125 * i, (x[i], y[i], heading[i]))
        places[name] = float(memory.offset)
    true = hand * (5.0 - x[-1])
    assert places["known"] == pytest.approx(true, abs=0.02)
    assert places["unknown"] != pytest.approx(true, abs=0.2)


@pytest.mark.parametrize("reports", ["place", "pose"])
def test_a_place_told_late_is_known_now(reports):
    car = load_car("rx7", (f"sensors.position.reports={reports}", "sensors.position.delay_s=0.05"))
    course = load_course("box")
    x, y, heading = course.start
    driver = drift_turn(course, car, straight_by="pose")
    pilot = Pilot.of(driver, course, car)
    simulator = Simulator.of(course, car, seed=2, start=(x - 0.1, y + 0.05, heading + 0.04))
    loop, memory = simulator.init(), pilot.init(simulator.root)
    off = []
    for _ in range(12):
        loop, memory, record = scan(simulator, pilot, 250, loop, memory)
        motion, known = loop.state.motion, memory.estimate
        off.append((known.x - motion.x, known.y - motion.y, known.belief.mean[3] - motion.heading))
        assert not np.any(record.wall_contacts)
    # The filter was at the last tick but four; at 2 m/s that is a centimetre.
    worst = np.max(np.abs(off[2:]), axis=0)
    assert np.all(worst < (0.02, 0.02, 0.06))


def test_whoever_is_told_the_truth_makes_no_errors():
    course, car, seeds = load_course("box"), load_car("rx7"), range(4)
    drawn = draw(load_population("around"), car, course, seeds, np.float64)
    driver = drift_turn(course, car)
    watch = Errors(
        legs=legs_of(course, 1), sonar=car.sensors.sonar, inside=float(chi2.ppf(0.95, 3))
    )
    pilot = Pilot.of(driver, course, car, "truth")
    score, kept = run_trials(course, pilot, drawn, [driver] * 4, seeds, 1, 12.0, watch, lanes=4)
    assert np.all(score.outcome == Outcome.REACHED.code)
    assert np.all(kept.drifting > 50)
    np.testing.assert_allclose(kept.slip, 0.0, atol=1e-12)
    assert np.all(np.degrees(np.sqrt(kept.reckoned / kept.drifting)) > 1.0)
    assert np.all(np.sqrt(kept.offset_error / kept.straight) < 0.1)
    assert np.all(np.sqrt(kept.angle_error / kept.straight) < math.radians(4))
    assert np.all(kept.pings > 100)
    assert jax.tree.all(jax.tree.map(lambda leaf: len(leaf) == 4, kept))
