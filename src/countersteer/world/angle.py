"""Cosine and sine as polynomials: in a batch, library calls are not vectorised."""

import math

import jax.numpy as jnp

from countersteer.signals import Scalar

# pi/2 as a sum. Thousands of multiples of the first two terms are exact even in 32 bits.
QUARTER = (1.5703125, 0.0004837512969970703, 7.549789954891882e-08)


def cosine_sine(angle: Scalar) -> tuple[Scalar, Scalar]:
    """Cosine and sine of an angle (rad), exact to rounding up to thousands of turns.

    The nearest multiple of pi/2 is subtracted. The rest, at most pi/4, enters a Taylor series.
    """
    terms = 9 if jnp.result_type(angle) == jnp.float64 else 6
    quarters = jnp.round(angle * (2 / math.pi))
    for part in QUARTER:
        angle = angle - quarters * part
    square = angle**2
    cosine: Scalar = 0.0
    sine: Scalar = 0.0
    for k in reversed(range(terms)):
        cosine = (-1) ** k / math.factorial(2 * k) + cosine * square
        sine = (-1) ** k / math.factorial(2 * k + 1) + sine * square
    sine = sine * angle
    count = quarters.astype(jnp.int32)
    odd = (count & 1) == 1
    cosine, sine = jnp.where(odd, sine, cosine), jnp.where(odd, cosine, sine)
    return (
        jnp.where(((count + 1) & 2) == 0, cosine, -cosine),
        jnp.where((count & 2) == 0, sine, -sine),
    )


def cosine(angle: Scalar) -> Scalar:
    """Cosine of an angle (rad), for a third of the work of `cosine_sine`.

    It is exact to rounding within a few turns. Whole turns are subtracted. The result is
    1 - 2 sin²(angle / 2), with a Taylor series of the sine up to pi/2.
    """
    terms = 10 if jnp.result_type(angle) == jnp.float64 else 6
    turns = angle * (1 / (2 * math.pi))
    half = math.pi * (turns - jnp.round(turns))
    sine: Scalar = 0.0
    for k in reversed(range(terms)):
        sine = (-1) ** k / math.factorial(2 * k + 1) + sine * half**2
    return 1 - 2 * (half * sine) ** 2
