"""The physics: one car in plain scalars; a batch is `jax.vmap`, a gradient is `jax.grad`."""
