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
from countersteer.course.position import legs_of
from countersteer.drivers.drift_turn import drift_turn
from countersteer.estimation import lidar_walls
from countersteer.estimation.kalman import diagonal
from countersteer.pilot import Pilot
from countersteer.sensing import lidar
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


def test_a_car_with_a_lidar_knows_its_corridor_behind_a_corner():
    """A beam may end on either wall of either corridor: the place before the corner says which."""
    course, car = load_course("box"), load_car("rx7", ("sensors.lidar.beams=24",))
    pilot = Pilot.of(drift_turn(course, car), course, car)
    simulator, legs = Simulator.of(course, car, seed=30003), legs_of(course, 1)
    loop, memory = simulator.init(), pilot.init(simulator.root)
    settled = []
    for _ in range(9):
        loop, memory, record = scan(simulator, pilot, 250, loop, memory)
        motion, told = loop.state.motion, record.status
        true = legs.seen(told.turn[-1], motion.x, motion.y, motion.heading)
        if told.turn[-1] and not told.phase[-1]:
            settled.append((told.offset[-1] - true.offset, told.angle[-1] - true.bearing))
    assert len(settled) >= 2
    assert np.max(np.abs(settled)) < 0.05
    assert not np.any(record.wall_contacts)


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
