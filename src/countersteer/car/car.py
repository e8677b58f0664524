"""`Car`: all declared parameters of a car, as a frozen pytree."""

import dataclasses

from countersteer.car.parameter import choice, count, parameter, pytree
from countersteer.signals import Scalar, Wheels

GRAVITY = 9.81  # m/s²
COMMONROAD = "CommonRoad vehicle models 3.0.2, tyre of its vehicles"


@pytree
class Body:
    """The rigid body: mass, outline, load transfer and impacts."""

    mass: Scalar = parameter(1.5, "kg", 0.02, 3000, "mass of the whole car")
    yaw_inertia: Scalar = parameter(
        0.02, "kg m2", 1e-6, 10000, "yaw inertia about the centre of mass, wheels included"
    )
    wheelbase: Scalar = parameter(0.25, "m", 0.03, 5, "distance between the axles")
    front_axle: Scalar = parameter(
        0.125, "m", 0.005, 4, "distance from the centre of mass forward to the front axle"
    )
    track: Scalar = parameter(0.16, "m", 0, 3, "distance between left and right wheels")
    cm_height: Scalar = parameter(0.04, "m", 0, 2, "height of the centre of mass")
    front_roll_share: Scalar = parameter(
        0.5, "1", 0, 1, "part of the load moved sideways that the front axle takes"
    )
    load_lag: Scalar = parameter(
        0.03, "s", 0.001, 1, "time constant with which wheel loads follow acceleration"
    )
    length: Scalar = parameter(0.4, "m", 0.03, 10, "length of the outline that hits walls")
    width: Scalar = parameter(0.18, "m", 0.02, 4, "width of the outline that hits walls")
    center: Scalar = parameter(
        0.0, "m", -5, 5, "centre of the outline, forward of the centre of mass"
    )
    wall_restitution: Scalar = parameter(
        0.2, "1", 0, 1, "speed after a hit over speed before it, along the wall's normal"
    )
    wall_friction: Scalar = parameter(0.4, "1", 0, 10, "friction between the body and walls")


@pytree
class MagicFormula:
    """Coefficients of a Magic Formula tyre without camber, by their names in the literature.

    p: pure slip, r: combined slip. c: shape, d: peak, e: curvature, k: stiffness, b: steepness,
    h and v: shifts. x: along the wheel, y: across. The defaults are those of a passenger car.
    """

    p_cx1: Scalar = parameter(1.6411, "1", 0.1, 3, "shape, along", COMMONROAD)
    p_dx1: Scalar = parameter(1.1739, "1", 0.01, 10, "peak friction, along", COMMONROAD)
    p_ex1: Scalar = parameter(0.46403, "1", -50, 1, "curvature, along", COMMONROAD)
    p_kx1: Scalar = parameter(22.303, "1", 0.1, 500, "slope over slip ratio, along", COMMONROAD)
    p_hx1: Scalar = parameter(0.0012297, "1", -0.2, 0.2, "shift of slip ratio", COMMONROAD)
    p_vx1: Scalar = parameter(-8.8098e-6, "1/N", -1, 1, "shift of the sine, along", COMMONROAD)
    r_bx1: Scalar = parameter(13.276, "1", 0, 200, "steepness of the loss along", COMMONROAD)
    r_bx2: Scalar = parameter(-13.778, "1", -200, 200, "its fall with slip ratio", COMMONROAD)
    r_cx1: Scalar = parameter(1.2568, "1", 0, 3, "shape of the loss along", COMMONROAD)
    r_ex1: Scalar = parameter(0.65225, "1", -50, 1, "curvature of the loss along", COMMONROAD)
    r_hx1: Scalar = parameter(0.0050722, "1", -0.2, 0.2, "its shift of slip angle", COMMONROAD)
    p_cy1: Scalar = parameter(1.3507, "1", 0.1, 3, "shape, across", COMMONROAD)
    p_dy1: Scalar = parameter(1.0489, "1", 0.01, 10, "peak friction, across", COMMONROAD)
    p_ey1: Scalar = parameter(-0.0074722, "1", -50, 1, "curvature, across", COMMONROAD)
    p_ky1: Scalar = parameter(-21.92, "1", -500, -0.1, "slope over slip angle", COMMONROAD)
    r_by1: Scalar = parameter(7.1433, "1", 0, 200, "steepness of the loss across", COMMONROAD)
    r_by2: Scalar = parameter(9.1916, "1", -200, 200, "its fall with slip angle", COMMONROAD)
    r_by3: Scalar = parameter(-0.027856, "1", -1, 1, "shift of that slip angle", COMMONROAD)
    r_cy1: Scalar = parameter(1.0719, "1", 0, 3, "shape of the loss across", COMMONROAD)
    r_ey1: Scalar = parameter(-0.27572, "1", -50, 1, "curvature of the loss across", COMMONROAD)
    r_hy1: Scalar = parameter(5.7448e-6, "1", -0.2, 0.2, "its shift of slip ratio", COMMONROAD)
    r_vy1: Scalar = parameter(
        -0.027825, "1", -1, 1, "force across that slip ratio makes", COMMONROAD
    )
    r_vy4: Scalar = parameter(12.12, "1", -200, 200, "its fall with slip angle", COMMONROAD)
    r_vy5: Scalar = parameter(1.9, "1", -10, 10, "shape of that force", COMMONROAD)
    r_vy6: Scalar = parameter(-10.704, "1", -200, 200, "its steepness", COMMONROAD)


@pytree
class Tire:
    """The wheels and tyres of one axle. Stiffness is per unit of load: N/N per rad."""

    law: str = choice(
        "brush",
        ("brush", "magic-formula"),
        "brush: friction and stiffnesses as here; magic-formula: the table magic_formula",
    )

    radius: Scalar = parameter(0.0315, "m", 0.003, 1, "rolling radius")
    width: Scalar = parameter(0.026, "m", 0.001, 1, "width, for pictures")
    inertia: Scalar = parameter(
        2e-5, "kg m2", 1e-9, 10, "spin inertia of one wheel with its share of the axle"
    )
    friction: Scalar = parameter(
        0.8, "1", 0.01, 10, "friction coefficient while the tread adheres; the brush's parabola"
    )
    sliding_ratio: Scalar = parameter(
        0.9, "1", 0, 1, "friction of the sliding tread over that of the adhering tread"
    )
    longitudinal_ratio: Scalar = parameter(
        1.0, "1", 0.2, 3, "friction along the wheel over that across it; 1: the same every way"
    )
    longitudinal_stiffness: Scalar = parameter(
        12.0, "1", 0.1, 200, "slope of force over slip ratio at zero slip, over the load"
    )
    cornering_stiffness: Scalar = parameter(
        8.0, "1", 0.1, 200, "slope of force over slip angle at zero slip, over the load"
    )
    cornering_drag: Scalar = parameter(
        0.0, "1", 0, 1, "rolling drag of a wheel over the tyre's force across it"
    )
    creep_speed: Scalar = parameter(
        0.05,
        "m/s",
        0.001,
        1,
        "speed added to the tread's, so that slip stays finite at rest; a contact creeps below it. "
        "Magic Formula: the least speed that slip is taken relative to",
    )
    magic_formula: MagicFormula = MagicFormula()

    @property
    def peak_friction(self) -> Scalar:
        """The largest force across the wheel, divided by the load."""
        if self.law == "magic-formula":
            return self.magic_formula.p_dy1
        return self.friction * (4 - 3 * self.sliding_ratio) / (3 - 2 * self.sliding_ratio) ** 2


@pytree
class Tires:
    """Tyres by axle."""

    front: Tire = Tire()
    rear: Tire = Tire()


@pytree
class Drivetrain:
    """The drivetrain from motor shaft to wheels: three differentials and drag.

    A lock of 0 is an open differential, 1 a solid shaft. Between them it is a viscous coupling.
    """

    front_share: Scalar = parameter(
        0.5, "1", 0, 1, "part of the torque that goes to the front axle: 1 FWD, 0 RWD"
    )
    front_lock: Scalar = parameter(0.0, "1", 0, 1, "lock of the front differential")
    center_lock: Scalar = parameter(1.0, "1", 0, 1, "lock between the axles; 0 for FWD and RWD")
    rear_lock: Scalar = parameter(0.0, "1", 0, 1, "lock of the rear differential")
    gear_ratio: Scalar = parameter(8.0, "1", 0.1, 200, "motor turns per wheel turn")
    efficiency: Scalar = parameter(0.85, "1", 0.05, 1, "of the motor's torque that reaches wheels")
    drag: Scalar = parameter(
        0.02, "N m", 0, 100, "dry drag of the driveline and of rolling, summed over the wheels"
    )
    drag_viscous: Scalar = parameter(
        5e-4, "N m s", 0, 10, "drag per wheel speed, summed over the wheels"
    )


@pytree
class Motor:
    """A brushed motor and its speed controller."""

    torque_constant: Scalar = parameter(
        0.012, "N m/A", 1e-5, 10, "torque per current, and back-EMF in V per rad/s"
    )
    resistance: Scalar = parameter(0.25, "ohm", 1e-3, 100, "of windings, leads and controller")
    rotor_inertia: Scalar = parameter(2e-6, "kg m2", 0, 1, "spin inertia of the rotor")
    current_limit: Scalar = parameter(60.0, "A", 0.1, 2000, "of the speed controller")
    dead_zone: Scalar = parameter(0.05, "1", 0, 0.9, "throttle below which nothing is driven")
    full_throttle: Scalar = parameter(1.0, "1", 0.1, 1, "throttle from which the duty is full")
    conduction: Scalar = parameter(
        1.0,
        "1",
        0,
        1,
        "part of the controller's pause through which current flows on: 1 all of it, as with a "
        "high inductance or a fast controller; 0 it dies at once",
    )
    overrun: Scalar = parameter(
        0.0, "1", 0, 1, "part of the braking current that flows when the car outruns its throttle"
    )
    neutral_brake: Scalar = parameter(
        0.1, "1", 0, 1, "part of the short-circuit braking at throttle 0"
    )
    brake: Scalar = parameter(
        1.0, "1", 0, 1, "part of the short-circuit braking at throttle -1 while rolling forward"
    )
    reverse: Scalar = parameter(1.0, "1", 0, 1, "duty at throttle -1 once the car stands")
    lag: Scalar = parameter(0.02, "s", 0.001, 1, "time constant of the duty behind the throttle")
    delay: Scalar = parameter(0.01, "s", 0, 0.3, "pure delay of the throttle")


@pytree
class SpeedController:
    """Sets the motor's duty for a commanded speed, as that of an F1TENTH car. Off (gain 0).

    It acts on commands in m/s only. Throttles pass it by.
    """

    gain: Scalar = parameter(0.0, "s/m", 0, 20, "duty per speed error; 0: no speed controller")
    feed_forward: Scalar = parameter(0.0, "s/m", 0, 10, "duty per commanded speed")
    throttle_limit: Scalar = parameter(1.0, "1", 0.01, 1, "largest duty towards the speed")
    brake_limit: Scalar = parameter(1.0, "1", 0, 1, "largest duty against the direction of travel")


@pytree
class Battery:
    """A pack. Its voltage sags with current, more so with wear, and falls as it discharges."""

    full: Scalar = parameter(9.6, "V", 0.5, 1000, "open-circuit voltage, fully charged")
    slope: Scalar = parameter(
        0.12, "1", 0, 1, "part of the voltage lost evenly between full and empty"
    )
    knee: Scalar = parameter(0.5, "1", 0, 1, "part of the voltage lost besides at the very end")
    knee_width: Scalar = parameter(0.06, "1", 0.005, 1, "charge over which the end comes")
    resistance: Scalar = parameter(0.12, "ohm", 1e-4, 100, "internal, of a new pack")
    capacity: Scalar = parameter(1.5, "C", 0.01, 1000, "of a new pack, in A h")
    wear: Scalar = parameter(0.0, "1", 0, 1, "0 new, 1 worn out")
    wear_resistance: Scalar = parameter(
        2.0, "1", 0, 20, "internal resistance added by full wear, over that of a new pack"
    )
    wear_capacity: Scalar = parameter(0.5, "1", 0, 0.95, "part of the capacity lost by full wear")


@pytree
class Servo:
    """The steering: from the commanded angle to the angles of the front wheels."""

    gain_left: Scalar = parameter(1.0, "1", 0.1, 5, "angle got per angle asked, to the left")
    gain_right: Scalar = parameter(1.0, "1", 0.1, 5, "angle got per angle asked, to the right")
    limit_left: Scalar = parameter(26.0, "rad", 1, 65, "largest angle to the left")
    limit_right: Scalar = parameter(26.0, "rad", 1, 65, "largest angle to the right")
    softness: Scalar = parameter(
        0.0, "1", 0, 1, "0: straight up to the limit; 1: bends towards it as a hyperbolic tangent"
    )
    trim: Scalar = parameter(0.0, "rad", -15, 15, "angle got when 0 is asked")
    rate: Scalar = parameter(400.0, "rad/s", 5, 5000, "largest speed of the front wheels' angle")
    lag: Scalar = parameter(0.03, "s", 0.001, 1, "time constant of the angle")
    delay: Scalar = parameter(0.01, "s", 0, 0.3, "pure delay of the steering")
    ackermann: Scalar = parameter(
        0.5, "1", -1, 1.5, "0: front wheels parallel; 1: both point at one centre of the turn"
    )


@pytree
class Mount:
    """Position and direction of a sonar."""

    x: Scalar = parameter(0.0, "m", -5, 5, "forward of the centre of mass")
    y: Scalar = parameter(0.0, "m", -3, 3, "left of the centre of mass")
    angle: Scalar = parameter(0.0, "rad", -180, 180, "direction of the beam, from straight ahead")


@pytree
class Sonar:
    """The sonars of a car, all of one kind."""

    mount_names: tuple[str, ...] = dataclasses.field(
        default=("front", "left", "right"), metadata={"static": True}
    )
    mounts: tuple[Mount, ...] = (Mount(), Mount(), Mount())
    rate: Scalar = parameter(40.0, "Hz", 0.1, 1000, "pings a second", "paper, II.B")
    firing: str = choice(
        "together",
        ("together", "in-turn"),
        "together: every sonar at each ping, and neighbours are heard; in-turn: one a ping",
    )
    reach: Scalar = parameter(3.5, "m", 0.1, 50, "largest distance", "paper, II.B")
    nearest: Scalar = parameter(0.03, "m", 0, 1, "smallest distance that it reports")
    half_angle: Scalar = parameter(
        22.0, "rad", 0.5, 80, "of the cone from which echoes come", "assumed; the paper says wide"
    )
    hearing: Scalar = parameter(
        50.0, "rad", 0.5, 89, "half-angle within which it hears the echoes of its neighbours' pings"
    )
    obliqueness: Scalar = parameter(
        45.0, "rad", 1, 89, "beyond this angle to its normal a wall returns no echo", "paper, II.B"
    )
    edge_echo: Scalar = parameter(
        0.15, "1", 0, 1, "chance that the edge of a wall within the cone returns an echo"
    )
    noise: Scalar = parameter(0.008, "m", 0, 1, "standard deviation of a distance")
    resolution: Scalar = parameter(0.01, "m", 0, 1, "step of a distance")


@pytree
class Encoder:
    """Counts black and white regions on a wheel or shaft, without their direction."""

    regions: Scalar = parameter(
        10.0, "1", 1, 10000, "black regions on the disc, and as many white ones", "paper, II.D"
    )
    update: Scalar = parameter(0.03, "s", 0.001, 1, "time over which regions are counted", "II.D")
    on: str = choice(
        "rear-left",
        ("shaft", "front-left", "front-right", "rear-left", "rear-right"),
        "the wheel that carries the disc; shaft: the driven one, seen from the wheels",
    )


@pytree
class Gyroscope:
    """A yaw-rate gyroscope."""

    rate: Scalar = parameter(200.0, "Hz", 0.1, 10000, "readings a second", "paper, II.E")
    reach: Scalar = parameter(300.0, "rad/s", 1, 10000, "largest yaw rate", "paper, II.F")
    noise: Scalar = parameter(2.0, "rad/s", 0, 1000, "standard deviation of a reading")
    bias: Scalar = parameter(0.3, "rad/s", -1000, 1000, "standing error")
    resolution: Scalar = parameter(1.2, "rad/s", 0, 1000, "step of a reading: 10 bits over ±600")


@pytree
class Accelerometer:
    """Forward and left acceleration at the centre of mass."""

    rate: Scalar = parameter(200.0, "Hz", 0.1, 10000, "readings a second")
    reach: Scalar = parameter(20.0, "m/s2", 0.1, 1000, "largest acceleration")
    noise: Scalar = parameter(0.3, "m/s2", 0, 100, "standard deviation of a reading")
    bias_x: Scalar = parameter(0.05, "m/s2", -20, 20, "standing error, forward")
    bias_y: Scalar = parameter(-0.05, "m/s2", -20, 20, "standing error, left")
    resolution: Scalar = parameter(0.04, "m/s2", 0, 10, "step of a reading")


@pytree
class Voltmeter:
    """The battery's voltage under load, as the microcontroller reads it."""

    rate: Scalar = parameter(20.0, "Hz", 0.1, 10000, "readings a second")
    noise: Scalar = parameter(0.03, "V", 0, 10, "standard deviation of a reading")
    resolution: Scalar = parameter(0.02, "V", 0, 10, "step of a reading")


@pytree
class LineDetector:
    """An eye that detects lines on the floor. Their spacing along the world's x axis is known."""

    lines: str = choice(
        "none",
        ("none", "across-x"),
        "none: no detector; across-x: lines across the world's x axis, one at x = 0",
    )
    spacing: Scalar = parameter(0.1, "m", 0.01, 100, "between the middles of two lines")
    width: Scalar = parameter(0.01, "m", 0, 1, "of a line; it is reported when the eye enters it")
    x: Scalar = parameter(0.0, "m", -5, 5, "of the eye, forward of the centre of mass")


@pytree
class Lidar:
    """A laser that measures along many beams at one instant. Off (0 beams) by default."""

    beams: int = count(
        0, 0, 2000, "beams, each in the middle of its part of the field; 0: no lidar"
    )
    field: Scalar = parameter(270.0, "rad", 1, 360, "angle that the beams cover")
    rate: Scalar = parameter(40.0, "Hz", 0.1, 1000, "readings a second, of all beams at once")
    reach: Scalar = parameter(10.0, "m", 0.1, 300, "largest distance")
    noise: Scalar = parameter(0.01, "m", 0, 1, "standard deviation of a distance")
    resolution: Scalar = parameter(0.001, "m", 0, 1, "step of a distance")
    x: Scalar = parameter(0.0, "m", -5, 5, "forward of the centre of mass")
    y: Scalar = parameter(0.0, "m", -3, 3, "left of the centre of mass")
    angle: Scalar = parameter(0.0, "rad", -180, 180, "middle of the field, from straight ahead")


@pytree
class Position:
    """Position of the centre of mass in the world's axes, measured externally. Off by default."""

    reports: str = choice(
        "none",
        ("none", "place", "pose"),
        "none: no such sensor; place: x and y, as GPS; pose: heading too, as motion capture",
    )
    rate: Scalar = parameter(100.0, "Hz", 0.1, 1000, "readings a second")
    noise: Scalar = parameter(0.001, "m", 0, 100, "standard deviation of x and of y")
    heading_noise: Scalar = parameter(0.3, "rad", 0, 180, "standard deviation of the heading")
    delay: Scalar = parameter(0.01, "s", 0, 1, "from the instant that is told to the reading")


@pytree
class Sensors:
    """The sensors of a car."""

    sonar: Sonar = Sonar()
    encoder: Encoder = Encoder()
    gyroscope: Gyroscope = Gyroscope()
    accelerometer: Accelerometer = Accelerometer()
    voltmeter: Voltmeter = Voltmeter()
    line_detector: LineDetector = LineDetector()
    lidar: Lidar = Lidar()
    position: Position = Position()


@pytree
class Car:
    """A car. Leaves are scalars in SI units and radians; their type decides the precision."""

    body: Body = Body()
    tires: Tires = Tires()
    drivetrain: Drivetrain = Drivetrain()
    motor: Motor = Motor()
    speed_controller: SpeedController = SpeedController()
    battery: Battery = Battery()
    servo: Servo = Servo()
    sensors: Sensors = Sensors()


def wheel_positions(body: Body) -> tuple[Wheels, Wheels]:
    """Positions of the wheels: x forward and y left of the centre of mass (m)."""
    front, rear, half = body.front_axle, body.front_axle - body.wheelbase, body.track / 2
    return Wheels(front, front, rear, rear), Wheels(half, -half, half, -half)
