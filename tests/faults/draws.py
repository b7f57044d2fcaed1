"""How a value is drawn from a seed's generator."""

import numpy as np


def one_of(rng: np.random.Generator, values):
    """Draw one of the values."""
    return values[int(rng.integers(len(values)))]


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw evenly in the logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
