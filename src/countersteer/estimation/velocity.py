"""The car's velocity: an extended Kalman filter over what gyroscope, accelerometer and encoder say.

From one reading of the accelerometer to the next, that carries the velocity on: it feels whatever
the tyres do, so a drift needs no tyre model. Its bias would let sideways speed run away within
seconds; while the tyres hold, the rear axle hardly moves sideways and the encoder's wheel rolls,
and both say so. Between readings, and where a sensor has died or is stuck, the nominal car's single
track goes on. Friction is felt where the rear axle slides, the battery under the motor's current,
the servo where the front tyres hold.

A car whose place is told from outside (`sensors.position`) has its place among the states; what is
told is of an instant before, by the sensor's delay, and is compared with where the car was then.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import GRAVITY, Car
from countersteer.car.parameter import pytree
from countersteer.estimation import battery, kalman, single_track, steering
from countersteer.estimation.battery import Pack
from countersteer.estimation.estimate import Estimate
from countersteer.estimation.kalman import Covariance, correct, entry, predict
from countersteer.estimation.single_track import Actuators
from countersteer.signals import Command, Reading, Readings, Scalar
from countersteer.world import motor
from countersteer.world.angle import cosine_sine
from countersteer.world.chassis import Symmetric, Vector
from countersteer.world.planar import rotated

# What the nominal car's declaration does not tell: how far the real one may be from it.
GYRO_BIAS = 0.005  # rad/s, standard deviation
ACCEL_BIAS = 0.06  # m/s²
WANDER = 0.001  # of the gyroscope's bias, rad/s per root second
START = 0.02  # heading at the start, rad
JERK = 1.5  # by which the yaw rate changes, rad/s per root second
HOLDS = 0.008  # m/s: how well a wheel that holds is known to roll,
KEEPS = 0.0022  # m/s: and an axle that holds not to slide
CREEPS = 0.085  # part by which the rear axle's creep is not what its tyre's stiffness makes of it
MEMORY = 0.2  # s for which that error stays the same
SLIDES = 1.5  # m/s: the same where the axle slides
ADHERES = 0.12  # rad of slip angle up to which an axle holds
USED = 0.6  # part of the nominal friction up to which it does
SMOOTH = 0.01  # s over which accelerations are looked at
LATE = 2.5  # periods of a sensor after which its last reading tells nothing
REPEATS = 20  # equal readings after which a sensor counts as stuck
SWING = 60.0  # rad/s² of yaw acceleration, and
JOLT = (
    500.0  # m/s³ of jerk, that no car makes: readings that differ by more have a spike among them
)
FASTEST = 20.0  # m/s, that no wheel of such a car turns at
SAGS = 0.3  # part of a full pack's voltage, by which no two readings of it differ,
SAME = 4  # and how many of it are equal in a row until the voltmeter counts as stuck
STEADY = 4  # readings in a row without, after such a one, until they are believed again
LEAP = 6.0  # standard deviations of noise by which readings may differ beside that
BLIND = 2.0  # m/s²: error of the single track's acceleration
BLIND_RATE = 1.0  # rad/s: of its yaw rate
FRICTION = 0.1  # deviation of the friction scale at the start
FELT = 0.09  # of a moment's friction
FORGETS = 0.05  # of the friction scale, per root second
LOST = 6  # reports of the encoder in a row, not believed, from which the speed is doubted
UNSURE = 3.0  # m/s per root second, by which it then is
GATE = 4.0  # standard deviations beyond which a reading is not believed
GYRO_GATE = 6.0  # the same of the gyroscope: a yaw rate changes by jerks

STRAYS = 0.01  # m per root second, by which the place errs beside what the velocity's error makes
PLACE = 0.1  # m, of the place at the start
PERIOD = 0.005  # s between two steps

VX, VY, RATE, HEADING, GYRO, AX, AY, ROLLED, X, Y = range(10)  # the last two: where it is told


class Sense(NamedTuple):
    """How a sensor is doing."""

    value: Scalar
    tick: Scalar
    repeats: Scalar  # readings in a row that were equal
    steady: Scalar  # and that followed the one before, as what they measure cannot leap


class Memory(NamedTuple):
    """The filter between two steps.

    Yaw rate and heading are those of `tick`; velocity, biases of the accelerometer and `rolled`
    those of `settled`, and `ahead` goes on from there.
    """

    mean: tuple[Scalar, ...]  # vx, vy, yaw rate, heading, biases (gyro, accel x, y), rolled(, x, y)
    covariance: Covariance
    tick: Scalar
    settled: Scalar  # tick of the accelerometer's last reading
    settled_heading: Scalar
    ahead: Vector  # velocity at `tick`
    x: Scalar
    y: Scalar
    accel_x: Scalar  # smoothed, m/s²
    accel_y: Scalar
    yaw_acceleration: Scalar
    friction: Scalar  # of the rear axle, over the nominal
    friction_variance: Scalar
    pack: Pack
    servo: steering.Servo
    actuators: Actuators
    gyroscope: Sense
    accelerometer: Sense  # forward,
    sideways: Sense  # and to the left
    encoder: Sense
    voltmeter: Sense
    position: Sense | None  # None: the car has no such sensor
    lost: Scalar  # reports of the encoder in a row that were not believed


def initial_memory(car: Car, pose: tuple[float, float, float], dtype: np.dtype) -> Memory:
    """At rest at a known pose, for the nominal car."""
    gyro, accel = car.sensors.gyroscope, car.sensors.accelerometer
    x, y, heading = (jnp.asarray(value, dtype) for value in pose)
    zero, one, none = dtype.type(0), dtype.type(1), np.int32(0)
    spread: tuple[float, ...] = (0.1, 0.05, 0.05, START, GYRO_BIAS, ACCEL_BIAS, ACCEL_BIAS, 0.01)
    quiet = Sense(zero, none, none, np.int32(STEADY))
    mean: tuple[Scalar, ...] = (
        zero,
        zero,
        zero,
        heading,
        gyro.bias,
        accel.bias_x,
        accel.bias_y,
        zero,
    )
    told = car.sensors.position.reports != "none"
    if told:
        mean, spread = (*mean, x, y), (*spread, PLACE, PLACE)
    memory = Memory(
        mean,
        kalman.diagonal([one * s for s in spread]),
        tick=none,
        settled=none,
        settled_heading=heading,
        ahead=Vector(zero, zero, zero),
        x=x,
        y=y,
        accel_x=zero,
        accel_y=zero,
        yaw_acceleration=zero,
        friction=one,
        friction_variance=one * FRICTION**2,
        pack=battery.initial(car),
        servo=steering.initial(),
        actuators=Actuators(zero, zero),
        gyroscope=quiet,
        accelerometer=quiet,
        sideways=quiet,
        encoder=quiet,
        voltmeter=quiet,
        position=quiet if told else None,
        lost=none,
    )
    return typed(memory, dtype)


def typed(memory: Memory, dtype: np.dtype) -> Memory:
    """Every number that is not a count in the precision of the car."""

    def leaf(value: Scalar) -> Scalar:
        whole = jnp.issubdtype(jnp.result_type(value), jnp.integer)
        return jnp.asarray(value, np.int32 if whole else dtype)

    typed: Memory = jax.tree.map(leaf, memory)
    return typed


def heard(
    sense: Sense,
    reading: Reading,
    rate: Scalar,
    tick: Scalar,
    dt: float,
    leap: Scalar = math.inf,
) -> tuple[Sense, Scalar, Scalar]:
    """A sensor with what it last said, whether that is new, and whether it is to be believed.

    It is not where it is late by more than its rate allows, stuck, no number, or leaping: spikes in
    a row that happen to lie near what is expected would else be believed one after another.
    """
    fresh = reading.tick > sense.tick
    same = reading.value == sense.value
    repeats = jnp.where(fresh, jnp.where(same, sense.repeats + 1, 0), sense.repeats)
    follows = jnp.abs(reading.value - sense.value) <= leap
    steady = jnp.where(fresh, jnp.where(follows, sense.steady + 1, 0), sense.steady)
    timely = (tick - reading.tick) * dt * rate < LATE
    sound = timely & (reading.tick > 0) & (repeats < REPEATS) & jnp.isfinite(reading.value)
    sense = Sense(reading.value, jnp.maximum(reading.tick, sense.tick), repeats, steady)
    return sense, fresh, sound & (steady >= STEADY)


def update(
    car: Car, memory: Memory, readings: Readings, command: Command, tick: Scalar, dt: float
) -> Memory:
    """The filter at `tick`, with what the readings have that is new, for the nominal car.

    `command` is what the driver asked for since the step before.
    """
    sensors, body = car.sensors, car.body
    mean, covariance = memory.mean, memory.covariance
    dtype = jnp.result_type(mean[VX])
    gyro, accel = sensors.gyroscope, sensors.accelerometer
    gyroscope, turned, gyro_sound = heard(
        memory.gyroscope,
        readings.gyroscope,
        gyro.rate,
        tick,
        dt,
        SWING / gyro.rate + LEAP * gyro.noise,
    )
    jolt = JOLT / accel.rate + LEAP * accel.noise
    accelerometer, weighed, accel_sound = heard(
        memory.accelerometer, readings.accel_x, accel.rate, tick, dt, jolt
    )
    sideways, _, sideways_sound = heard(
        memory.sideways, readings.accel_y, accel.rate, tick, dt, jolt
    )
    accel_sound = accel_sound & sideways_sound
    tire = car.tires.rear if "rear" in sensors.encoder.on else car.tires.front
    region = jnp.pi * tire.radius / sensors.encoder.regions
    encoder, counted, _ = heard(
        memory.encoder,
        readings.counts,
        1 / sensors.encoder.update,
        tick,
        dt,
        FASTEST * sensors.encoder.update / region,
    )
    rolling = encoder.steady >= STEADY  # a wheel at rest repeats itself: that is no fault
    voltmeter, probed, probe_sound = heard(
        memory.voltmeter,
        readings.battery,
        sensors.voltmeter.rate,
        tick,
        dt,
        SAGS * car.battery.full,
    )
    probed = probed & probe_sound & (voltmeter.repeats < SAME)
    behind = body.wheelbase - body.front_axle
    seconds = lambda ticks: (ticks * dt).astype(dtype)  # noqa: E731  # used five times

    # What the single track makes of the command.
    h = seconds(tick - memory.tick)
    actuators = single_track.follow(car, memory.actuators, command, h)
    slip_speed = memory.ahead.y - behind * memory.ahead.yaw
    slip = jnp.abs(slip_speed) / (jnp.abs(memory.ahead.x) + 0.3)
    rolls = slip < ADHERES
    wheel = readings.wheel_speed.value
    wheel = jnp.where(jnp.isfinite(wheel) & rolling, wheel, memory.ahead.x)
    rim = jnp.where(rolls, memory.ahead.x, wheel)
    drive = motor.drive(
        car.motor,
        car.drivetrain,
        battery.as_believed(car, memory.pack),
        actuators.duty,
        1.0,
        rim / car.tires.rear.radius,
    )
    guess = single_track.step(car, memory.ahead, actuators, drive, memory.friction, h)
    # Between two readings the last one is held: measured to be the better guess.
    held = rotated(memory.ahead, h * memory.ahead.yaw)
    ahead = Vector(
        jnp.where(accel_sound, held.x + h * memory.accel_x, guess.x),
        jnp.where(accel_sound, held.y + h * memory.accel_y, guess.y),
        jnp.where(gyro_sound, held.yaw, guess.yaw),
    )
    believed = battery.update(
        car, memory.pack, readings.battery.value, drive.battery_current, probed, h
    )

    # Yaw rate and heading.
    restless = jnp.where(entry(covariance, RATE, RATE) < BLIND_RATE**2, JERK**2 * h, 0.0)
    covariance = predict(covariance, {HEADING: {RATE: h}}, {RATE: restless, GYRO: WANDER**2 * h})
    heading = mean[HEADING] + h * (memory.ahead.yaw + ahead.yaw) / 2
    mean = (*mean[:RATE], ahead.yaw, heading, *mean[GYRO:])
    saturated = jnp.abs(gyroscope.value) > 0.99 * gyro.reach
    mean, covariance, _ = correct(
        mean,
        covariance,
        {RATE: 1.0, GYRO: 1.0},
        gyroscope.value - mean[RATE] - mean[GYRO],
        gyro.noise**2 + gyro.resolution**2 / 12 + 1e-8 + jnp.where(saturated, 0.1, 0.0),
        turned & gyro_sound,
        GYRO_GATE,
    )
    rate = mean[RATE]
    # The single track erred by this at the end, so by half of it on the way.
    since = jnp.where(turned, seconds(gyroscope.tick - memory.gyroscope.tick), 0.0)
    heading = mean[HEADING] + jnp.minimum(since, 0.2) * (rate - ahead.yaw) / 2
    turning = (rate - memory.ahead.yaw) / jnp.maximum(h, 1e-6)
    blend = -jnp.expm1(-h / SMOOTH)
    yaw_acceleration = memory.yaw_acceleration + blend * (turning - memory.yaw_acceleration)

    # The velocity goes on to the accelerometer's reading; without one, as the single track does.
    measured = weighed & accel_sound
    blind = ~measured & (seconds(tick - memory.settled) * accel.rate > LATE)
    settled = jnp.where(measured, accelerometer.tick, jnp.where(blind, tick, memory.settled))
    h_settled = seconds(settled - memory.settled)
    per = 1 / jnp.maximum(h_settled, 1e-6)
    vx, vy, _, _, _, bias_x, bias_y, rolled, *place = mean
    turn = jnp.where(h_settled > 0, heading - memory.settled_heading, 0.0)
    forward = jnp.where(measured, readings.accel_x.value - bias_x, (ahead.x - vx) * per - rate * vy)
    left = jnp.where(measured, readings.accel_y.value - bias_y, (ahead.y - vy) * per + rate * vx)
    reach = 0.99 * accel.reach
    hit = (jnp.abs(readings.accel_x.value) > reach) | (jnp.abs(readings.accel_y.value) > reach)
    shaken = (accel.noise**2 + accel.resolution**2 / 12) * h_settled**2 + jnp.where(hit, 1.0, 0.0)
    shaken = jnp.where(measured, shaken, BLIND**2 * SMOOTH * h_settled)
    blend = -jnp.expm1(-h_settled / SMOOTH)
    accel_x = memory.accel_x + blend * (forward - memory.accel_x)
    accel_y = memory.accel_y + blend * (left - memory.accel_y)

    # How hard the axles work, and whether they hold.
    lever = body.yaw_inertia * yaw_acceleration / body.mass
    front_push = (accel_y * behind + lever) / body.wheelbase
    bend = jnp.tan(actuators.steering)
    # The front axle's outer wheel bears more, and holds back more: that turns the car as well.
    lever = lever + bend * front_push * body.cm_height * accel_y / GRAVITY
    rear_load = (body.front_axle * GRAVITY + body.cm_height * accel_x) / body.wheelbase
    rear_pull = (accel_y * body.front_axle - lever) / (body.wheelbase * rear_load)
    # What pushes forward is the wheels' pull, less what the front axle's side force holds back.
    pull = (accel_x + bend * front_push) / GRAVITY
    front_load = (behind * GRAVITY - body.cm_height * accel_x) / body.wheelbase
    driven = car.drivetrain.front_share * GRAVITY * pull
    cosine, sine = cosine_sine(actuators.steering)
    front_pull = (front_push - sine * driven) / (cosine * front_load)
    grip = jnp.minimum(car.tires.rear.peak_friction, car.tires.front.peak_friction)
    used = jnp.sqrt(accel_x**2 + accel_y**2) / (GRAVITY * grip)
    holds = rolls & (used < USED)
    # A tread gives more than in proportion to its pull: the brush model's law, turned round.
    share = jnp.sqrt(pull**2 + rear_pull**2) / (memory.friction * car.tires.rear.peak_friction)
    gives = steering.gives(share)

    # The encoder's wheel: `rolled` is what it has rolled since the regions counted so far.
    side = {"rear-left": 1.0, "front-left": 1.0, "rear-right": -1.0, "front-right": -1.0}
    arm = side.get(sensors.encoder.on, 0.0) * body.track / 2
    stretch = 1 + gives * pull / tire.longitudinal_stiffness
    known = jnp.where(holds, HOLDS, SLIDES) ** 2 * 2 * MEMORY * h_settled
    # A wheel that keeps rolling otherwise than it should: then it is the speed that is wrong.
    astray = jnp.where(memory.lost >= LOST, UNSURE**2 * h_settled, 0.0)
    in_play = jnp.where(measured, h_settled, 0.0)
    cosine, sine = cosine_sine(heading)
    onward = Vector(cosine * vx - sine * vy, sine * vx + cosine * vy, rate)  # in the world's axes
    moves: dict[int, kalman.Row] = {}
    if place:
        moves = {
            X: {VX: h_settled * cosine, VY: -h_settled * sine, HEADING: -h_settled * onward.y},
            Y: {VX: h_settled * sine, VY: h_settled * cosine, HEADING: h_settled * onward.x},
        }
        place = [place[0] + h_settled * onward.x, place[1] + h_settled * onward.y]
    covariance = predict(
        covariance,
        {
            VX: {VY: turn, RATE: h_settled * vy, AX: -in_play},
            VY: {VX: -turn, RATE: -h_settled * vx, AY: -in_play},
            ROLLED: {VX: h_settled * stretch, RATE: -h_settled * arm},
            **moves,
        },
        {
            VX: shaken + astray,
            VY: shaken,
            ROLLED: known,
            **dict.fromkeys(moves, STRAYS**2 * h_settled),
        },
    )
    # Half the turn before the push and half after it: a free velocity keeps its length.
    halfway = rotated(Vector(vx, vy, rate), turn / 2)
    after = rotated(
        Vector(halfway.x + h_settled * forward, halfway.y + h_settled * left, rate), turn / 2
    )
    rolled = rolled + h_settled * (stretch * (vx + after.x) / 2 - arm * rate)

    # The regions counted since: what is left of `rolled` is within one of them.
    passed = jnp.where(counted & rolling, encoder.value - memory.encoder.value, 0.0)
    backwards = jnp.where(after.x < 0, -1.0, 1.0)
    late = jnp.where(counted, seconds(settled - encoder.tick), 0.0)
    rolled = rolled - backwards * passed * region
    mean = (after.x, after.y, rate, heading, mean[GYRO], bias_x, bias_y, rolled, *place)
    mean, covariance, taken = correct(
        mean,
        covariance,
        {ROLLED: 1.0, VX: -late},
        backwards * region / 2 - (rolled - late * after.x),
        region**2 / 12,
        counted & rolling,
        GATE,
    )
    # After a slide or a lost report it begins anew within its region.
    failed = counted & ~taken
    anew = jnp.where(failed, backwards * region / 2, mean[ROLLED])
    mean = (*mean[:ROLLED], anew, *mean[ROLLED + 1 :])
    covariance = kalman.renewed(covariance, ROLLED, region**2 / 12, failed)
    doubts = jnp.where(taken | (passed == 0), 0, memory.lost + 1)
    lost = jnp.where(counted & rolling, doubts, memory.lost)

    # The rear axle's tread creeps sideways by the slip angle that its pull takes.
    creep = -jnp.abs(mean[VX]) * gives * rear_pull / car.tires.rear.cornering_stiffness
    mean, covariance, _ = correct(
        mean,
        covariance,
        {VY: 1.0, RATE: -behind},
        creep - (mean[VY] - behind * mean[RATE]),
        (KEEPS + CREEPS * jnp.abs(creep)) ** 2 * 2 * MEMORY * per,
        holds & (h_settled > 0),
        GATE,
    )

    # Where the car was, as told from outside.
    position = memory.position
    told_x, told_y = readings.position_x, readings.position_y
    if position is not None and told_x is not None and told_y is not None:
        part = sensors.position
        position, placed, told = heard(position, told_x, part.rate, tick, dt)
        late = seconds(settled - position.tick) + part.delay
        for state, reading, row in (
            (X, told_x, {VX: -late * cosine, VY: late * sine}),
            (Y, told_y, {VX: -late * sine, VY: -late * cosine}),
        ):
            then = mean[state] + sum(slope * mean[i] for i, slope in row.items())
            mean, covariance, _ = correct(
                mean,
                covariance,
                {state: 1.0, **row},
                reading.value - then,
                part.noise**2 + 1e-8,
                placed & told & jnp.isfinite(reading.value),
                GATE,
            )
        if readings.position_heading is not None:
            late = seconds(tick - position.tick) + part.delay
            off = readings.position_heading.value - (mean[HEADING] - late * mean[RATE])
            off = off - 2 * jnp.pi * jnp.round(off / (2 * jnp.pi))
            row = {HEADING: 1.0, RATE: -late}
            noise = part.heading_noise**2 + 1e-8
            mean, covariance, _ = correct(mean, covariance, row, off, noise, placed & told, GATE)

    # Where the rear axle slides, its pull is its friction, against the slip.
    slip_y = mean[VY] - behind * mean[RATE]
    slip_x = mean[VX] - arm * mean[RATE] - wheel
    rear = car.tires.rear
    against = -slip_y / jnp.sqrt(slip_x**2 + slip_y**2 + 1e-6)
    full = rear.sliding_ratio * rear.friction * against
    sliding = rear.cornering_stiffness * jnp.abs(slip_y) > 4 * rear.friction * memory.friction * (
        wheel + 0.1
    )
    # Against the turn, the front wheels' pulls differ and turn the car by what is not known here.
    countersteers = actuators.steering * mean[RATE] < 0
    (friction,), ((friction_variance,),), _ = correct(
        (memory.friction,),
        predict(((memory.friction_variance,),), {}, {0: FORGETS**2 * h_settled}),
        {0: full},
        rear_pull - full * memory.friction,
        (FELT * rear.friction) ** 2 * 2 * MEMORY * per,
        sliding & measured & (jnp.abs(against) > 0.5) & ~countersteers,
        GATE,
    )

    servo = steering.update(
        memory.servo,
        actuators.steering,
        (actuators.steering - memory.actuators.steering) / jnp.maximum(h, 1e-6),
        jnp.arctan2(mean[VY] + body.front_axle * mean[RATE], mean[VX]),
        front_pull,
        car.tires.front.peak_friction,
        car.tires.front.cornering_stiffness,
        jnp.minimum(car.servo.limit_left, car.servo.limit_right),
        mean[VX],
        measured,
        h_settled,
    )

    stands = h_settled > 0
    ahead = Vector(
        jnp.where(stands, mean[VX], ahead.x), jnp.where(stands, mean[VY], ahead.y), mean[RATE]
    )
    cosine, sine = cosine_sine(mean[HEADING])
    since = h
    x, y = memory.x, memory.y
    if place:
        since, x, y = seconds(tick - settled), mean[X], mean[Y]
    return typed(
        Memory(
            mean,
            covariance,
            tick,
            settled,
            jnp.where(stands, mean[HEADING], memory.settled_heading),
            ahead,
            x + since * (cosine * ahead.x - sine * ahead.y),
            y + since * (sine * ahead.x + cosine * ahead.y),
            accel_x,
            accel_y,
            yaw_acceleration,
            jnp.clip(friction, 0.2, 3.0),
            friction_variance,
            believed,
            servo,
            actuators,
            gyroscope,
            accelerometer,
            sideways,
            encoder,
            voltmeter,
            position,
            lost,
        ),
        dtype,
    )


def estimate(car: Car, memory: Memory, dt: float) -> Estimate:
    """What the filter believes."""
    mean, p = memory.mean, memory.covariance
    dtype = jnp.result_type(mean[VX])
    astray = BLIND**2 * SMOOTH * ((memory.tick - memory.settled) * dt).astype(dtype)
    voltage, resistance = memory.pack.mean
    servo = memory.servo
    pose = Symmetric(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    if len(mean) > X:
        at = ((X, X), (Y, Y), (HEADING, HEADING), (X, Y), (X, HEADING), (Y, HEADING))
        pose = Symmetric(*(entry(p, i, j) for i, j in at))
    return Estimate(
        memory.x,
        memory.y,
        mean[HEADING],
        memory.ahead.x,
        memory.ahead.y,
        memory.ahead.yaw,
        mean[GYRO],
        memory.friction,
        jnp.sqrt(memory.friction_variance),
        voltage / car.battery.full,
        resistance,
        servo.mean[0],
        jnp.sqrt(entry(servo.covariance, 0, 0)),
        Symmetric(
            entry(p, VX, VX) + astray,
            entry(p, VY, VY) + astray,
            entry(p, RATE, RATE),
            entry(p, VX, VY),
            entry(p, VX, RATE),
            entry(p, VY, RATE),
        ),
        pose,
    )


@pytree
class VelocityFilter:
    """The filter as an `Estimator`, for the nominal car at a known start."""

    car: Car
    start: tuple[Scalar, Scalar, Scalar]  # x, y, heading
    dt: float = dataclasses.field(metadata={"static": True})
    name = "filter"
    takes_truth = False
    period = PERIOD

    def init(self, key: jax.Array) -> Memory:
        """At rest at the start."""
        del key
        return initial_memory(self.car, self.start, jnp.result_type(self.car.body.mass))

    def update(self, memory: Memory, readings: Readings, command: Command, tick: Scalar) -> Memory:
        """The filter at `tick`, with what the readings have that is new."""
        return update(self.car, memory, readings, command, tick, self.dt)

    def estimate(self, memory: Memory) -> Estimate:
        """What the filter believes."""
        return estimate(self.car, memory, self.dt)
