"""A similar car in MuJoCo, for the bench: a comparison with a widely used engine."""

from collections.abc import Callable

import mujoco  # type: ignore[import-untyped]  # it ships no types
import numpy as np
from mujoco import rollout

from countersteer.car.car import Car, wheel_positions
from countersteer.course.course import Course

WHEEL_MASS, WHEEL_WIDTH = 0.04, 0.015  # kg, m (half)
WALL = 0.02  # m, half of a wall's thickness
NAMES = ("fl", "fr", "rl", "rr")


def model(car: Car, course: Course, dt: float) -> mujoco.MjModel:
    """Chassis and four wheels without suspension: five bodies, twelve degrees of freedom.

    Position actuators steer the front wheels. A motor turns each wheel. Only wheels and floor, and
    chassis and walls, can touch. Ellipsoid wheels (one contact each) and the `implicitfast`
    integrator with MuJoCo's default solver were the fastest of those tried.
    """
    body, front, rear = car.body, car.tires.front, car.tires.rear
    spec = mujoco.MjSpec()
    spec.option.timestep = dt
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    floor = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
    floor.contype, floor.conaffinity = 1, 2
    for ax, ay, bx, by in course.walls:
        length = float(np.hypot(bx - ax, by - ay)) / 2
        angle = float(np.arctan2(by - ay, bx - ax)) / 2
        wall = spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[length, WALL, 0.1],
            pos=[(ax + bx) / 2, (ay + by) / 2, 0.1],
            quat=[np.cos(angle), 0, 0, np.sin(angle)],
        )
        wall.contype, wall.conaffinity = 4, 8
    chassis = spec.worldbody.add_body(name="chassis", pos=[0, 0, float(front.radius)])
    chassis.add_freejoint()
    shell = chassis.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[float(body.length) / 2, float(body.width) / 2, 0.02],
        pos=[0, 0, float(body.cm_height)],
        mass=float(body.mass) - 4 * WHEEL_MASS,
    )
    shell.contype, shell.conaffinity = 8, 4
    for name, x, y in zip(NAMES, *wheel_positions(body), strict=True):
        steered, tire = name[0] == "f", front if name[0] == "f" else rear
        hub = chassis.add_body(name=name, pos=[float(x), float(y), 0])
        if steered:
            hub.add_joint(name=f"steer_{name}", axis=[0, 0, 1], damping=0.01)
        hub.add_joint(name=f"spin_{name}", axis=[0, 1, 0])
        wheel = hub.add_geom(
            type=mujoco.mjtGeom.mjGEOM_ELLIPSOID,
            size=[float(tire.radius), WHEEL_WIDTH, float(tire.radius)],
            mass=WHEEL_MASS,
            friction=[float(tire.friction), 0.005, 0.0001],
        )
        wheel.contype, wheel.conaffinity = 2, 1
    for name in NAMES[:2]:
        steering = spec.add_actuator(name=f"steer_{name}", target=f"steer_{name}")
        steering.trntype = mujoco.mjtTrn.mjTRN_JOINT
        steering.set_to_position(kp=2.0)
    for name in NAMES:
        motor = spec.add_actuator(name=f"spin_{name}", target=f"spin_{name}")
        motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
        motor.gear = [0.05, 0, 0, 0, 0, 0]
    return spec.compile()


def batch(
    compiled: mujoco.MjModel, cars: int, steps: int, threads: int
) -> Callable[[], np.ndarray]:
    """A function that drives `cars` cars for `steps` steps on `threads` threads.

    It returns their end positions (m): (cars, 2).
    """
    data = [mujoco.MjData(compiled) for _ in range(threads)]
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    settled = np.zeros(mujoco.mj_stateSize(compiled, kind))
    for _ in range(200):
        mujoco.mj_step(compiled, data[0])
    mujoco.mj_getState(compiled, data[0], settled, kind)
    rng = np.random.default_rng(0)
    controls = np.concatenate(
        [
            rng.uniform(-0.4, 0.4, (cars, 1, 1)).repeat(2, axis=2),  # rad
            rng.uniform(0.2, 0.8, (cars, 1, 1)).repeat(4, axis=2),
        ],
        axis=2,
    ).repeat(steps, axis=1)
    pool = rollout.Rollout(nthread=threads if threads > 1 else 0)

    def run() -> np.ndarray:
        path, _ = pool.rollout(
            compiled, data if threads > 1 else data[0], np.tile(settled, (cars, 1)), controls
        )
        ends: np.ndarray = path[:, -1, 1:3]
        return ends

    return run
