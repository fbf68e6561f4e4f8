"""The engine that plays a pipeline's instructions in `jax.numpy`, compiled by XLA; JAX is needed only here.

`scan` is one compiled scan over the ticks of a run, `batch` the same under `vmap` over many; `engine` is its
face.
"""
