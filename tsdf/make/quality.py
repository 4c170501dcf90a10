"""Quality: three words for how much is traced and kept, for those who do not think in paths."""

from typing import NamedTuple


class Quality(NamedTuple):
    """What a word stands for, as `Effort` has it."""

    target_error: float  # total variation of p_theta [1]
    joint: int  # records per cell of theta
    memory: int  # records per cell of entry


QUALITIES = {
    "draft": Quality(0.02, 8, 32),  # a first look
    "good": Quality(0.005, 32, 64),  # pictures
    "final": Quality(0.0025, 64, 64),  # measurements
}
