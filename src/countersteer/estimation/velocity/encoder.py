"""The encoder: how far its wheel has rolled since the regions counted so far.

`ROLLED` is that way. When a report comes, it is within one region; so a report says where within.
"""

import jax.numpy as jnp

from countersteer.car.car import Car
from countersteer.estimation import kalman
from countersteer.estimation.velocity.hold import MEMORY, Effort
from countersteer.estimation.velocity.predict import Rolling
from countersteer.estimation.velocity.soundness import HeardSenses, encoder_region, encoder_tire
from countersteer.estimation.velocity.states import ROLLED, VX, Belief
from countersteer.signals import Scalar

HOLDS = 0.008  # m/s: standard deviation of the rim's speed where its axle holds,
SLIDES = 1.5  # and where it slides
LOST = 6  # reports in a row, rejected, from which the speed itself is doubted,
UNSURE = 3.0  # by so much: m/s per root second
GATE = 4.0  # standard deviations beyond which a report is rejected


def wheel_arm(car: Car) -> float | Scalar:
    """How far the encoder's wheel is to the left of the middle (m); 0 for an axle's mean."""
    side = {"rear-left": 1.0, "front-left": 1.0, "rear-right": -1.0, "front-right": -1.0}
    return side.get(car.sensors.encoder.on, 0.0) * car.body.track / 2


def rolling(car: Car, work: Effort, lost: Scalar, h: Scalar) -> Rolling:
    """Over h seconds; a driven tyre turns faster than the car by its slip ratio."""
    stiffness = encoder_tire(car).longitudinal_stiffness
    return Rolling(
        1 + work.gives * work.pull / stiffness,
        wheel_arm(car),
        jnp.where(work.holds, HOLDS, SLIDES) ** 2 * 2 * MEMORY * h,
        jnp.where(lost >= LOST, UNSURE**2 * h, 0.0),
    )


def correct_by_encoder(
    car: Car, belief: Belief, heard: HeardSenses, before: Scalar, lost: Scalar, age: Scalar
) -> tuple[Belief, Scalar]:
    """With the encoder's report, and how many in a row are now rejected.

    `before` is the count of the report before, `age` how long ago this one was made (s).
    """
    region = encoder_region(car)
    counted = heard.encoder.fresh
    valid = counted & heard.rolling
    passed = jnp.where(valid, heard.encoder.sense.value - before, 0.0)
    backwards = jnp.where(belief.mean[VX] < 0, -1.0, 1.0)
    late = jnp.where(counted, age, 0.0)
    rolled = belief.mean[ROLLED] - backwards * passed * region
    belief, accepted = belief.replace({ROLLED: rolled}).correct(
        {ROLLED: 1.0, VX: -late},
        backwards * region / 2 - (rolled - late * belief.mean[VX]),
        region**2 / 12,
        valid,
        GATE,
    )
    # After a slide or a lost report, the way rolled starts anew within its region.
    failed = counted & ~accepted
    anew = jnp.where(failed, backwards * region / 2, belief.mean[ROLLED])
    covariance = kalman.renewed(belief.covariance, ROLLED, region**2 / 12, failed)
    doubts = jnp.where(accepted | (passed == 0), 0, lost + 1)
    return (
        Belief(belief.mean, covariance).replace({ROLLED: anew}),
        jnp.where(valid, doubts, lost),
    )
