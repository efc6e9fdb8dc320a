"""When an effect of a sensor counts (decision 0063), as for axes but for the floor: a sensor's is of its own rows."""

from __future__ import annotations

GAIN = 0.05  # least share of what remains that an effect must save on held-out blocks
SURE = 2.0  # least number of standard errors of that saving
FLOOR = 1.15  # stop at this multiple of the noise floor
#: A saving below ``SPECIFIC`` counts only where no unrelated effect saves ``NEARLY`` as much.
SPECIFIC = 0.3
NEARLY = 0.5
#: A larger loss than this is one, however unevenly it falls on the blocks.
DOUBTFUL = 0.2


def negligible(lost: float, errors: float) -> bool:
    """Say whether a loss counts for nothing: small, or not large and within one standard error."""
    return lost < GAIN or (errors < 1.0 and lost < DOUBTFUL)
