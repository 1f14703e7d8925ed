"""A recording on a model's time axis, or the reason why the model cannot judge it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from motor_env.diagnosis.estimation.starts.start_identification import identify
from motor_env.diagnosis.readers.alignment import Alignment, align
from motor_env.diagnosis.readers.recording import Recording, UnusableError
from motor_env.diagnosis.readers.start import prepare
from motor_env.inference.class_model import FEATURE_NAMES, physical_features
from motor_env.inference.posterior import variance_factor
from motor_env.motor.model import State
from motor_env.motor.parameters import Channel, FloatArray
from motor_env.simulation.recipes import Recipe
from motor_env.simulation.simulate import simulate_states

_FINE_SHIFTS = np.arange(-3.0, 3.02, 0.05)
# Of the model's sampling interval: the rise of a start is too quick for coarser lines.
_COARSEST_TO_INTERPOLATE = 0.25
# Standard deviations of chi2 beyond which the start is not of a motor that the model knows.
_LARGEST_MISFIT = 5.0
_VOLTAGE_TOLERANCE = 0.05


def aligned_case(
    recording: Recording, recipe: Recipe, noise_range: tuple[float, float] | None = None
) -> FloatArray:
    """The recording on the recipe's time axis, shape (1, n_channels, n_samples).

    At equal rates the start is fitted with its onset free, and moved onto a sample by what the fit says: a step
    between two samples looks like another motor, for the current rises by amperes in a sample. A faster recording is
    interpolated at the shift where the recipe's motor, parameters free, fits best. The mean of the quiet part before
    the start is taken off the current; nothing else is normalised.

    Args:
        recording: as read.
        recipe: of the model.
        noise_range: factors on the recipe's noise between which the model reads the noise off the start itself.

    Raises:
        UnusableError: the model was trained for other motors, supplies, channels or time axes than this.
        ValueError: the model was trained for motors at work.
    """
    recipe.require_step()
    start = align(recording)
    _check_comparable(recording, recipe, start)
    if abs(recording.dt_s / recipe.timing.dt_s - 1.0) < 1e-3:
        shifted = _moved_onto_a_sample(recording, recipe)
    else:
        shifted = np.stack([_resampled(recording, recipe, start, shift) for shift in _FINE_SHIFTS])
    features = physical_features(recipe, shifted)
    misfit = features[:, FEATURE_NAMES.index("reduced_chi2")]
    best = int(misfit.argmin())
    n_values = shifted[0].size
    noisiest = max(map(variance_factor, recipe.classes))
    largest = noisiest * (1.0 + _LARGEST_MISFIT * np.sqrt(2.0 / n_values))
    level = 1.0 if noise_range is None else _noise_level(shifted[best], recipe, noise_range)
    if misfit[best] > level * largest:
        raise UnusableError(
            "no motor that the model knows fits this start: "
            f"the squared residual is {misfit[best] / level:.3g} times the noise's"
        )
    return shifted[best : best + 1]


def _noise_level(case: FloatArray, recipe: Recipe, noise_range: tuple[float, float]) -> float:
    """Variance of the noise over the recipe's, from differences of neighbours (von Neumann 1941), within the range.

    The second half of a start changes slowly beside the noise: what is left is slow misfit, not noise.
    """
    settled = case[:, case.shape[1] // 2 :] / recipe.sensor.noise_std[:, None]
    level = float(np.square(np.diff(settled, axis=1)).mean() / 2.0)
    return float(np.clip(level, noise_range[0] ** 2, noise_range[1] ** 2))


def _moved_onto_a_sample(recording: Recording, recipe: Recipe) -> FloatArray:
    """What the fit leaves over, on top of the fitted motor's response to a step at a sample: shape (1, ...)."""
    timing = recipe.timing
    prepared = prepare(recording, float(np.asarray(recipe.supply.voltage_v)))
    # The recipe's supply is a step; a measured voltage would also bring its noise, and pin the onset to its samples.
    fitted = identify(replace(prepared, voltage_v=None))
    start = fitted.start
    step = int(np.abs(start.time_s - fitted.onset_s).argmin())
    rows = np.arange(timing.n_samples) + step + 1 - timing.n_quiet
    if rows[0] < 0 or rows[-1] >= len(start.time_s):
        raise UnusableError(
            f"the model wants {timing.quiet_s:g} s before the start and {timing.duration_s:g} s after it"
        )
    voltage = start.level_v * (np.arange(timing.n_samples) >= timing.n_quiet)
    response = simulate_states(fitted.parameters, voltage, timing.dt_s)
    left = {Channel.CURRENT: fitted.residual_a[rows]}
    if start.speed_rad_s is not None:
        left[Channel.SPEED] = (start.speed_rad_s - fitted.expected[:, 1])[rows]
    columns = {Channel.CURRENT: response[:, State.CURRENT], Channel.SPEED: response[:, State.SPEED]}
    return np.stack([left[channel] + columns[channel] for channel in recipe.sensor.channels])[None]


def _check_comparable(recording: Recording, recipe: Recipe, start: Alignment) -> None:
    timing = recipe.timing
    if Channel.SPEED in recipe.sensor.channels and recording.speed_rad_s is None:
        raise UnusableError("the model wants the speed, which was not recorded")
    ratio = recording.dt_s / timing.dt_s
    if abs(ratio - 1.0) >= 1e-3 and ratio > _COARSEST_TO_INTERPOLATE:
        raise UnusableError(
            f"sampled at {1.0 / recording.dt_s:.6g} Hz, the model wants {timing.sampling_rate_hz:g} Hz, or four times "
            f"that and more; train it with --sampling-rate-hz {1.0 / recording.dt_s:.6g}"
        )
    left = float(recording.time_s[-1]) - start.onset_s
    if left < timing.duration_s - 0.5 * timing.dt_s:
        raise UnusableError(f"{left:.3g} s after the start, the model wants {timing.duration_s:g} s")
    if recording.voltage_v is not None:
        level = float(np.median(np.abs(recording.voltage_v[start.onset_index + 1 :])))
        wanted = float(np.asarray(recipe.supply.voltage_v))
        if abs(level - wanted) > _VOLTAGE_TOLERANCE * wanted:
            raise UnusableError(f"the supply is at {level:.4g} V, the model was trained at {wanted:g} V")


def _resampled(recording: Recording, recipe: Recipe, start: Alignment, shift: float) -> FloatArray:
    """Channels of the recipe on its time axis, the onset moved by `shift` of its samples."""
    onset_s = recording.time_s[start.onset_index]
    at = onset_s + shift * recipe.timing.dt_s + recipe.timing.time_s
    columns = {Channel.CURRENT: start.sign * (recording.current_a - start.offset_a)}
    if recording.speed_rad_s is not None:
        columns[Channel.SPEED] = start.sign * recording.speed_rad_s
    return np.stack([np.interp(at, recording.time_s, columns[channel]) for channel in recipe.sensor.channels])
