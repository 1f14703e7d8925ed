"""Tests of a filter's consistency with its measurements.

If the model holds, whitened innovations are independent standard normal (Bar-Shalom, Li & Kirubarajan 2001, ch. 5.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from motor_env.common.arrays import numbers
from motor_env.motor.parameters import require

_LAGS = 20  # of the whiteness test
_LEVEL = 0.01 / 3.0  # of each test


@dataclass(frozen=True, slots=True)
class Consistency:
    """Three tests of whitened innovations.

    Attributes:
        n_values: innovations tested.
        mean_p: that their mean is 0.
        nis_p: that their mean square is 1.
        whiteness_p: that they are uncorrelated over the lags (Ljung & Box 1978).
        mean_square: mean square of the innovations.
    """

    n_values: int
    mean_p: float
    nis_p: float
    whiteness_p: float
    mean_square: float

    @property
    def holds(self) -> bool:
        """Whether none of the three tests rejects, at 1 % for all together (Bonferroni 1936)."""
        return min(self.mean_p, self.nis_p, self.whiteness_p) >= _LEVEL

    @property
    def warning(self) -> str:
        """A sentence that names the inconsistent tests; empty if there are none."""
        if self.holds:
            return ""
        tests = (
            (self.mean_p, "their mean is not 0"),
            (self.nis_p, f"their mean square is {self.mean_square:.3g} instead of 1"),
            (self.whiteness_p, "they are correlated in time"),
        )
        defects = [defect for p_value, defect in tests if p_value < _LEVEL]
        return (
            f"the recording is not consistent with the model: of {self.n_values} whitened innovations "
            + ", ".join(defects)
            + "; thresholds that assume a consistent filter do not keep their false-alarm rate"
        )


def check_consistency(whitened: ArrayLike) -> Consistency:
    """Test whitened innovations of one or many transients (Bar-Shalom, Li & Kirubarajan 2001; Ljung & Box 1978).

    Args:
        whitened: shape (..., n_samples, n_channels), as in `FilterResult.whitened`; NaN is missing.

    Raises:
        ValueError: not more samples than lags, or no measured ones.
    """
    values = numbers("whitened", whitened, ("...", "n_samples", "n_channels"), missing=True)
    require(
        values.shape[-2] > _LAGS,
        f"whitened must have shape (..., n_samples > {_LAGS}, n_channels), got {values.shape}",
    )
    measured = ~np.isnan(values)
    count = int(measured.sum())
    require(count > 0, "whitened must hold a measured sample, got none")
    known = np.where(measured, values, 0.0)
    squares = float(np.square(known).sum())
    tail = float(special.chdtr(count, squares))
    statistic = 0.0
    for lag in range(1, _LAGS + 1):
        pairs = float((measured[..., lag:, :] & measured[..., :-lag, :]).sum())
        # With the variance 1 that the belief claims each lag's sum has variance `pairs`.
        if pairs:
            statistic += float((known[..., lag:, :] * known[..., :-lag, :]).sum()) ** 2 / pairs
    return Consistency(
        n_values=count,
        mean_p=float(2.0 * special.ndtr(-abs(known.sum()) / np.sqrt(count))),
        nis_p=2.0 * min(tail, float(special.chdtrc(count, squares))),
        whiteness_p=float(special.chdtrc(_LAGS, statistic)),
        mean_square=squares / count,
    )
