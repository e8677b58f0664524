"""The two steps of an extended Kalman filter, for one car in plain scalars.

The matrices of a filter of some eight states are sparse. They are written out: where Python knows
that a number is zero, nothing is computed. So a batch is a `vmap` without matrices.
"""

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import jax.numpy as jnp

from countersteer.signals import Scalar

Covariance: TypeAlias = tuple[tuple[Scalar, ...], ...]  # row i holds its columns i, i + 1, ...
Row: TypeAlias = Mapping[int, Scalar]  # the non-zero entries of a matrix's row


def diagonal(deviations: Sequence[Scalar]) -> Covariance:
    """The covariance of independent states with these standard deviations."""
    n = len(deviations)
    return tuple(
        tuple(deviations[i] ** 2 if j == i else 0.0 * deviations[i] for j in range(i, n))
        for i in range(n)
    )


def entry(covariance: Covariance, i: int, j: int) -> Scalar:
    """The covariance of the states i and j."""
    return covariance[min(i, j)][abs(i - j)]


def predict(covariance: Covariance, moves: Mapping[int, Row], noise: Row) -> Covariance:
    """(I + A) P (I + A)ᵀ + Q. `moves` holds the rows of A, `noise` the diagonal of Q."""
    n = len(covariance)
    full = [[entry(covariance, i, j) for j in range(n)] for i in range(n)]
    for i, row in moves.items():  # (I + A) P, each row from the rows of the old P
        full[i] = [
            full[i][j] + sum(a * entry(covariance, k, j) for k, a in row.items()) for j in range(n)
        ]
    return tuple(
        tuple(
            full[i][j]
            + sum(a * full[i][k] for k, a in moves.get(j, {}).items())
            + (noise.get(i, 0.0) if i == j else 0.0)
            for j in range(i, n)
        )
        for i in range(n)
    )


def correct(
    mean: Sequence[Scalar],
    covariance: Covariance,
    row: Row,
    residual: Scalar,
    noise: Scalar,
    valid: Scalar,
    gate: float,
) -> tuple[tuple[Scalar, ...], Covariance, Scalar]:
    """Mean and covariance after a scalar measurement, and whether it was accepted.

    `row` is the measurement's derivative by the states, `residual` is measured less expected,
    `noise` the measurement's variance. Nothing changes if `valid` is false, or if the residual
    exceeds `gate` standard deviations. Residual and noise may be NaN then.
    """
    n = len(mean)
    across = [sum(a * entry(covariance, i, k) for k, a in row.items()) for i in range(n)]
    spread = sum(a * across[k] for k, a in row.items()) + noise
    accepted = valid & (residual**2 <= gate**2 * spread)
    weight = jnp.where(accepted, 1 / spread, 0.0)
    residual = jnp.where(accepted, residual, 0.0)
    gain = [a * weight for a in across]
    return (
        tuple(m + g * residual for m, g in zip(mean, gain, strict=True)),
        tuple(
            tuple(covariance[i][j - i] - gain[i] * across[j] for j in range(i, n)) for i in range(n)
        ),
        accepted,
    )


def renewed(covariance: Covariance, state: int, variance: Scalar, now: Scalar) -> Covariance:
    """If `now`, with one state reset: to this variance, and independent of the others."""
    return tuple(
        tuple(
            jnp.where(now, variance if i == j == state else 0.0, value)
            if state in (i, j)
            else value
            for j, value in enumerate(row, start=i)
        )
        for i, row in enumerate(covariance)
    )
