"""The clock that all cars of a batch share."""

import jax
import jax.numpy as jnp

from countersteer.signals import Scalar


@jax.custom_batching.custom_vmap
def shared(condition: Scalar) -> Scalar:
    """A condition on the clock. For a batch, only the branch that it selects is computed.

    Its value is the same for all cars, so the batched result has no axis of cars. Without this,
    `vmap` computes both branches for every car where the condition comes out of a car's memory.
    """
    return condition


@shared.def_vmap
def _of_a_batch(size: int, batched: list[bool], condition: Scalar) -> tuple[Scalar, bool]:
    del size
    return (jnp.any(condition, axis=0) if batched[0] else condition), False
