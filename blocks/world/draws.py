"""Random numbers of the simulated world: one generator for each (seed, name), none shared.

What is drawn under one name depends on that name and the seed alone, so a sensor more or less, or a changed
setting, never changes the draws of another. Longer recordings begin with the draws of shorter ones.
"""

from __future__ import annotations

import zlib

import numpy as np

__all__ = ["generator"]


def generator(seed: int, name: str) -> np.random.Generator:
    """The generator of `name`, such as "gyro.noise", for one `seed` (a whole number, not negative)."""
    return np.random.Generator(np.random.Philox(np.random.SeedSequence([seed, zlib.crc32(name.encode())])))
