"""Slow oracle for the posterior over training objects: plain loops over Python numbers, in float64."""

import math
from collections.abc import Sequence


def posterior(
    readout: Sequence[float], lights: Sequence[Sequence[float]], labels: Sequence[int], n_classes: int, detector: str
) -> list[float]:
    """P(class | readout) when the world holds just the objects whose photoelectrons are `lights`."""
    logs = []
    for light in lights:
        log_likelihood = 0.0
        for n, rate in zip(readout, light):
            if detector == "counting":
                log_likelihood += n * math.log(rate) - rate - math.lgamma(n + 1)
            else:
                log_likelihood += math.log(-math.expm1(-rate)) if n else -rate
        logs.append(log_likelihood)
    top = max(logs)
    of_class = [0.0] * n_classes
    for log_likelihood, label in zip(logs, labels):
        of_class[label] += math.exp(log_likelihood - top)
    return [value / math.fsum(of_class) for value in of_class]
