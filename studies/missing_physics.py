"""What the model lacks: extra laws, fitted together with the car and judged on other logs.

    python -m studies.missing_physics FITTED.toml PRIOR.toml RUN... --validate RUN...

FITTED is what `tune` made of RUN… from PRIOR (cars of other floors are beside both). Each variant
adds a law to the car's physics. The search goes on from FITTED with the law's numbers free beside
all that `tune` fits. Numbers of 0 leave the physics as it is; their priors are 0 ± `WIDTHS`.

- load sensitivity: friction times (load / load at rest)^-s, for each axle. The friction of rubber
  falls as the load rises: s is positive.
- steering compliance: the front wheels give way by c times the lateral acceleration.
- residual: accelerations forward, left and of yaw from `CENTRES` Gaussians over what drives the
  motion: vx, vy, yaw rate, steering, duty. A mirrored motion has mirrored accelerations. Away from
  the fitted windows they are 0.
"""

import argparse
import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.cluster.vq import kmeans2

from countersteer.car.car import Car
from countersteer.car.files import load_car
from countersteer.car.parameter import changed, parameter, pytree
from countersteer.compiling import configure_jax
from countersteer.runs.run import read_run
from countersteer.signals import Motion, Scalar, Wheels
from countersteer.tuning import fit, tune
from countersteer.tuning.shooting import BEFORE, SAMPLE, Shots
from countersteer.world import chassis, planar
from countersteer.world.planar import State

WINDOWS = tune.MOST
CENTRES = 8
ACCELERATIONS = ("forward", "left", "yaw")
REACH = np.array([0.7, 0.4, 1.5, 0.15, 0.3])  # widths of a Gaussian: m/s, m/s, rad/s, rad, 1
MIRRORED = np.array([1.0, -1.0, -1.0, -1.0, 1.0])
LEAST = 0.05  # load over that at rest; below it, friction does not rise any more
LOADS = ("extra.load_front", "extra.load_rear")
COMPLIANCE = ("extra.compliance",)
RESIDUAL = tuple(f"extra.{name}_{i}" for i in range(CENTRES) for name in ACCELERATIONS)
EXTRAS = (*LOADS, *COMPLIANCE, *RESIDUAL)
WIDTHS = {  # of the priors: 1, 1, rad per m/s², m/s² and rad/s²
    **dict.fromkeys(LOADS, 0.1),
    **dict.fromkeys(COMPLIANCE, 0.01),
    **{path: 2.0 if ".yaw_" in path else 0.5 for path in RESIDUAL},
}
VARIANTS = {
    "nothing more": (),
    "load sensitivity": LOADS,
    "steering compliance": COMPLIANCE,
    "residual": RESIDUAL,
    "residual, none forward": tuple(path for path in RESIDUAL if ".forward_" not in path),
}


def slides(shots: Shots) -> np.ndarray:
    """True for windows of forward driving that reach 20° of sideslip: (windows,)."""
    vx, vy = shots.measured[:, 0], shots.measured[:, 1]
    forward = (vx > 0).all(axis=1) & (shots.velocity.x > 0)
    return forward & (np.arctan2(np.abs(vy), vx) > np.radians(20)).any(axis=1)


PARTS = {
    "all": fit.any_window,
    "where something changes": tune.transient,
    "slides": slides,
}

_fields = {
    path.removeprefix("extra."): parameter(0.0, "1", -20, 20, "of a law on trial")
    for path in EXTRAS
}
_types = {"__annotations__": dict.fromkeys(_fields, Scalar)}
Extra: Any = pytree(type("Extra", (), _types | _fields))


@pytree
class Wide(Car):
    """A car with the numbers of all laws on trial."""

    extra: Any = Extra()


def grip(plain: Any, car: Any, motion: Motion, friction: Wheels | None = None) -> planar.Grip:
    """`planar.grip` with steering that gives way, and friction that depends on the load."""
    rest = chassis.wheel_loads(car.body, 0.0, 0.0)
    loads = chassis.wheel_loads(car.body, motion.load_ax, motion.load_ay)
    front, rear = car.extra.load_front, car.extra.load_rear
    factors = [
        jnp.maximum(load / still, LEAST) ** -power
        for load, still, power in zip(loads, rest, (front, front, rear, rear), strict=True)
    ]
    if friction is not None:
        factors = [a * b for a, b in zip(factors, friction, strict=True)]
    bent = motion.steering - car.extra.compliance * motion.load_ay
    return plain(car, motion._replace(steering=bent), Wheels(*factors))


def move(plain: Any, centres: np.ndarray, state: State, tick: planar.Tick) -> Any:
    """`planar.move`, followed by what the residual accelerates."""
    car: Any = tick.car
    weights = jnp.stack([getattr(car.extra, path.removeprefix("extra.")) for path in RESIDUAL])
    push = residual(centres, weights.reshape(CENTRES, 3), state.motion)
    state, tick = plain(state, tick)
    m, h = state.motion, tick.dt
    faster = m._replace(
        vx=m.vx + h * push[0], vy=m.vy + h * push[1], yaw_rate=m.yaw_rate + h * push[2]
    )
    return state._replace(motion=faster), tick


def residual(centres: np.ndarray, weights: Any, m: Motion) -> Any:
    """Accelerations (3,) from Gaussians at centres (n, 5), in units of `REACH`."""
    at = jnp.stack([m.vx, m.vy, m.yaw_rate, m.steering, m.duty]) / REACH
    found = [
        jnp.exp(-jnp.sum((at * side - centres) ** 2, axis=1) / 2) @ weights * side[:3]
        for side in (np.ones(5), MIRRORED)
    ]
    return found[0] + found[1]


def centres_of(shots: Shots) -> np.ndarray:
    """Where the fitted windows are, mirrored to left turns: (CENTRES, 5), in units of `REACH`."""
    samples, every = shots.measured.shape[-1], round(SAMPLE / fit.STEP)
    first = round(BEFORE / fit.STEP) + every
    throttle, steering = (line[:, first::every][:, :samples] for line in shots.commands)
    seen = np.moveaxis(shots.measured[:, :3], 1, 2).reshape(-1, 3)
    rows = np.column_stack([seen, steering.ravel(), throttle.ravel()])
    rows = rows[np.isfinite(rows).all(axis=1)]
    rows = np.where(rows[:, 2:3] < 0, rows * MIRRORED, rows) / REACH
    return kmeans2(rows, CENTRES, minit="++", rng=np.random.default_rng(0))[0]


def widened(car: Car) -> Wide:
    """The car with laws on trial that do nothing."""
    return Wide(**{field.name: getattr(car, field.name) for field in dataclasses.fields(Car)})


def put_on_trial(centres: np.ndarray) -> None:
    """Have the fit know the numbers of the laws, and the world obey them."""
    of_car = (*fit.OF_CAR, *EXTRAS)
    vars(fit).update(Car=Wide, OF_CAR=of_car, TABLE=(*of_car, fit.CHARGE))
    fit.ABSOLUTE.update(WIDTHS)
    planar.grip = jax.jit(functools.partial(grip, planar.grip))
    planar.move = functools.partial(move, planar.move, centres)


def cars_of(path: str, named: set[str]) -> dict[str, Car]:
    """The car of a file, and those of other floors beside it."""
    base = Path(path).stem
    found = tune.by_surface(base, load_car(path), tune.other_floors(path, named - {base}))
    return {name: widened(car) for name, car in found.items()}


def line(title: str, cars: dict[str, Car], shots: Shots) -> str:
    """A row of the table: medians after a second, of forward, lateral, yaw rate and wheels."""
    found = tune.judged(cars, shots)
    cells = [
        f"{found['errors'][name]['median_abs_error']:.3f} "
        f"({found['persistence'][name]['median_abs_error']:.3f})"
        for name in tune.QUANTITIES
        if name in found["errors"]
    ]
    return f"| {title} | {found['windows']} | {' | '.join(cells)} |"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    reads = argparse.ArgumentParser(description=__doc__)
    reads.add_argument("fitted")
    reads.add_argument("prior")
    reads.add_argument("runs", nargs="+")
    reads.add_argument("--validate", nargs="+", required=True)
    reads.add_argument("--windows", type=int, default=WINDOWS, help="of a fit, at most")
    reads.add_argument("--laws", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    asked = reads.parse_args(arguments)
    configure_jax(blocks=True)
    with jax.enable_x64(True):
        runs, others = (
            [read_run(Path(p)) for p in paths] for paths in (asked.runs, asked.validate)
        )
        named = {str(run.about.get("car_name", "")) for run in runs + others}
        base = Path(asked.fitted).stem
        found, prior = cars_of(asked.fitted, named), cars_of(asked.prior, named)
        logs = tune.read_logs(runs, found, tune.EVERY, base)
        thin = logs.where(tune.spread(logs.run, asked.windows))
        unseen = tune.read_logs(others, found, tune.EVERY, base)
        put_on_trial(centres_of(thin.shots))
        # As in `fit.fit`: what slow driving tells of the steering is not searched for.
        told = [one.path for one in fit.told(thin.shots, found[base])]
        for path in told:
            value = np.float64(fit.value_of(found[base], path))
            prior = {floor: changed(car, path, value) for floor, car in prior.items()}
        charge = fit.estimated_charge(found, thin.shots)
        for name in asked.laws:
            more: tuple[str, ...] = VARIANTS[name]
            free = [p for p in (*fit.PARAMETERS, *more, fit.CHARGE) if p not in told]
            problem = fit.Problem(prior, thin.shots, free)
            begin = fit.Problem(found, thin.shots, free, None, charge).start
            solved = problem.solve(begin, fit.PASSES)
            cars = problem.cars_at(solved.x)
            values = problem.outside(solved.x)
            numbers = {
                p.path: round(float(v), 3)
                for p, v in zip(problem.parameters, values, strict=True)
                if p.path in more
            }
            print(name, f"cost {solved.cost:.2f}", numbers, flush=True)
            known = unseen.with_charge(fit.estimated_charge(cars, unseen.shots))
            for i, run in enumerate(others):
                chosen = known.run == i
                if not chosen.any():
                    continue
                shots = known.where(chosen).shots
                for what, some in PARTS.items():
                    part = fit.select(shots, some(shots))
                    if len(part.run):
                        print(line(f"{name}: {run.path.name}, {what}", cars, part), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
