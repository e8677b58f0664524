"""Random streams: each draw of a drive has a key of its own, and each number a draw of its own."""

import itertools

import jax
import numpy as np

from conftest import driven
from countersteer import random_streams
from countersteer.batch.population import draw, load_population
from countersteer.car.files import load_car
from countersteer.course.files import load_course
from countersteer.drivers.drift_turn import drift_turn
from countersteer.random_streams import Stream


def test_no_two_streams_nor_ticks_nor_seeds_share_a_key():
    """Keys that are drawn from, and those that a draw may split them into."""

    def keys(seed):
        root = random_streams.root(seed)
        once = [random_streams.key(root, stream) for stream in Stream]
        often = [
            jax.vmap(lambda tick, s=stream: random_streams.key(root, s, tick))(np.arange(500))
            for stream in Stream
        ]
        drawn = np.concatenate([jax.random.key_data(k).reshape(-1, 2) for k in (*once, *often)])
        split = jax.vmap(lambda k: jax.random.split(k, 4))(often[Stream.SONAR - 1])
        return np.concatenate([drawn, jax.random.key_data(split).reshape(-1, 2)])

    found = np.concatenate([keys(seed) for seed in (0, 1, 2**31 - 1)])
    assert len(np.unique(found, axis=0)) == len(found)


def test_what_splits_and_what_folds_would_have_met():
    """Why a key is never both: this is what JAX makes of the two."""
    key = jax.random.key(3)
    for i, half in enumerate(jax.random.split(key)):
        assert np.array_equal(*map(jax.random.key_data, (half, jax.random.fold_in(key, i))))


def test_the_noises_of_a_drive_are_independent_of_each_other_and_of_the_floor():
    course, car = load_course("box"), load_car("rx7")
    record = driven(course, car, drift_turn(course, car), 3.0)
    readings, motion = record.readings, record.motion
    noises = []
    for reading, true in (
        (readings.gyroscope, motion.yaw_rate),
        (readings.accel_x, np.gradient(motion.vx, 1e-3) - motion.yaw_rate * motion.vy),
        (readings.accel_y, np.gradient(motion.vy, 1e-3) + motion.yaw_rate * motion.vx),
    ):
        new = (reading.tick == record.tick) & (record.tick > 200) & (record.tick < 1000)
        noises.append((reading.value - true)[new])
    floors = draw(load_population("around"), car, course, range(len(noises[0])), float).floor
    waves = np.ravel([np.asarray(wave.phase) for wave in floors.waves[:1]])
    for one, other in itertools.combinations([*noises, waves], 2):
        assert abs(np.corrcoef(one, other[: len(one)])[0, 1]) < 4 / np.sqrt(len(one))
