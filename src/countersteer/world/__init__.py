"""The physics of one car, in scalars. `jax.vmap` gives a batch, `jax.grad` a gradient."""
