"""Where a start begins, and what the quiet part and the noise tell: to the sample, by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from motor_env import Recording
from motor_env.diagnosis.readers.alignment import align
from motor_env.diagnosis.readers.noise import (
    PeriodicLine,
    difference_noise,
    line_share,
    outlier_samples,
    periodic_lines,
    quantisation_bias,
    without_outliers,
)
from motor_env.diagnosis.readers.start import prepare


def noisy(n: int = 1000, *, noise: float = 0.02, offset: float = 0.1, sign: float = 1.0) -> Recording:
    """A start at sample 200."""
    since = np.maximum(np.arange(n) - 199.0, 0.0)
    current = 5.0 * (np.exp(-since / 300.0) - np.exp(-since / 3.0)) + 0.05 * (since > 0.0)
    shown = sign * current + offset + noise * np.random.default_rng(1).standard_normal(n)
    return Recording(Path("start"), 1e-4 * np.arange(float(n)) - 0.01, shown)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_start_is_aligned_to_the_sample(sign: float) -> None:
    recording = noisy(sign=sign)
    found, quiet = (
        align(recording),
        recording.current_a[:198],
    )  # two samples before the onset may belong to it
    assert (found.onset_index, found.sign, found.n_quiet) == (200, sign, 198)
    assert found.onset_s == pytest.approx(0.01 - 0.5e-4)
    assert (found.offset_a, found.noise_a) == pytest.approx((quiet.mean(), quiet.std(ddof=1)))
    steps = np.abs(np.diff(recording.current_a))
    assert found.quantum_a == pytest.approx(steps[steps > 0.0].min())
    assert (found.defects, found.rectified) == ((), False)
    start = prepare(recording, 12.0)
    assert (start.level_v, start.voltage_known, start.from_rest) == (12.0, True, True)
    np.testing.assert_allclose(start.current_a, sign * recording.current_a)
    assert start.alignment.offset_a == pytest.approx(sign * quiet.mean())
    assert len(start.shortened(50).time_s) == 250
    early = align(replace(recording, time_s=recording.time_s[:800], current_a=recording.current_a[200:]))
    assert (early.onset_index, early.n_quiet, early.offset_a) == (0, 0, 0.0)


@pytest.mark.parametrize(
    ("levels", "onset"),
    [
        (((2000, 0.0), (5, 0.0795), (50, 0.0)), 2055),  # a bump below 0.08 of the peak is no start
        (((2000, 0.0), (2, 0.5), (50, 0.0)), 2052),  # nor is one of two samples
        (((2000, 0.0), (7, 0.00505)), 2000),  # its foot reaches down to 0.005 of the peak
        (((3, 0.5), (2, 0.5995), (1995, 0.5)), 2000),  # the level before it is believed where it is quiet
        (((3, 0.5), (2, 0.6005), (1995, 0.5)), 0),
    ],
)
def test_borders_of_an_onset(levels: tuple[tuple[int, float], ...], onset: int) -> None:
    pieces = (*levels, (40_000, 1.0 + levels[-1][1] * (levels[-1][0] == 1995)))
    current = np.concatenate([np.full(n, level) for n, level in pieces])
    current = current + 1e-6 * np.random.default_rng(4).standard_normal(len(current))
    assert align(Recording(Path("x"), 1e-3 * np.arange(float(len(current))), current)).onset_index == onset


def test_what_a_sensor_does_to_a_current_is_told() -> None:
    plain = noisy(noise=0.0, offset=0.0).current_a
    span = float(np.ptp(plain))
    for step, is_said in ((0.0045 * span, False), (0.0055 * span, True)):
        found = align(replace(noisy(), current_a=step * np.round(plain / step)))
        assert found.quantum_a == pytest.approx(step)
        assert any("quantisation" in words for words in found.defects) is is_said
    shown = 0.003 * span * np.round(plain / (0.003 * span))
    shown[50] = 0.003 * span  # one step before the start: the converter's own error is more than what is seen
    assert align(replace(noisy(), current_a=shown)).noise_a == pytest.approx(0.003 * span / math.sqrt(12.0))
    clipped = np.minimum(0.005 * np.round(plain / 0.005), 3.0)
    run = int((clipped == 3.0).sum())
    found = align(replace(noisy(), current_a=clipped))
    assert found.saturation == f"saturation: {run} samples in a row stand at 3 A"
    assert found.saturation in found.defects
    halved = np.maximum(noisy(offset=0.0).current_a, 0.0)
    found = align(replace(noisy(), current_a=halved))
    assert (found.rectified, found.offset_a) == (True, 0.0)
    assert found.noise_a == pytest.approx(math.sqrt(2.0 * np.mean(halved[: found.onset_index - 2] ** 2)))
    assert "rectification: no current lies below 0" in found.defects


def test_the_noise_of_second_differences() -> None:
    """Whose values are the quantiles of a normal distribution: the estimate is its standard deviation."""
    quantiles = stats.norm.ppf((np.arange(100_000) + 0.5) / 100_000)
    values = np.cumsum(np.cumsum(np.random.default_rng(3).permutation(quantiles)))
    for scale in (1.0, 30.0):
        assert difference_noise(scale * values) == pytest.approx(scale / math.sqrt(6.0), rel=1e-3)
    second = np.array([0.0, 0.0, 0.0, 0.0, 8.0, -8.0, 0.0, 0.0])  # most are 0: half of their deviation
    rare = np.cumsum(np.cumsum(second))
    assert difference_noise(rare) == pytest.approx(0.5 * np.std(second[2:]) / math.sqrt(6.0))
    assert difference_noise(np.arange(4.0) ** 2) == 0.0


def test_a_wild_sample_stands_out_of_neighbours_that_agree() -> None:
    """By a twentieth of the current's range, ten noises, five times as far as its neighbours differ."""
    base = np.where(np.arange(2000) < 1100, 0.0, 1.0)
    noise = 0.05 * np.random.default_rng(4).standard_normal(2000)
    for shown, size, is_wild in (
        (base, 0.045, False),
        (base, 0.055, True),
        (base + noise, 0.35, False),
        (base + noise, 0.75, True),
    ):
        current = shown.copy()
        current[500] = np.median(current[[498, 499, 501, 502]]) + size
        assert (500 in outlier_samples(current)) is is_wild
    for apart, is_wild in ((0.199, True), (0.201, False)):
        current = base.copy()
        current[500], current[501] = 1.0, apart
        assert (500 in outlier_samples(current)) is is_wild
    spikes = base.copy()
    spikes[[100, 200]] = 1.0
    assert outlier_samples(spikes) == (100, 200)  # one in a thousand
    spikes[300] = 1.0
    assert outlier_samples(spikes) == ()
    assert outlier_samples(spikes[80:129]) == ()  # 49 samples are too few
    assert without_outliers(np.array([1.0, 9.0, 3.0]), [1]).tolist() == [1.0, 2.0, 3.0]


def test_lines_of_the_spectrum_have_their_frequency_and_amplitude() -> None:
    time_s = 1e-4 * np.arange(1000.0)
    noise = 0.01 * np.random.default_rng(6).standard_normal(1000)
    line = PeriodicLine(1234.5, 0.3, -0.4)
    ripple = 0.3 * np.cos(2469.0 * math.pi * time_s) - 0.4 * np.sin(2469.0 * math.pi * time_s)
    assert line.amplitude_a == pytest.approx(0.5)
    np.testing.assert_allclose(line.current_a(time_s), ripple)

    def found(*lines: PeriodicLine) -> tuple[PeriodicLine, ...]:
        return tuple(periodic_lines(sum((one.current_a(time_s) for one in lines), noise + 3.0), time_s))

    one, two = found(line, PeriodicLine(3210.0, 0.1, 0.0))
    assert (one.frequency_hz, two.frequency_hz) == pytest.approx((1234.5, 3210.0), abs=1.0)
    assert (one.cosine_a, one.sine_a, two.amplitude_a) == pytest.approx((0.3, -0.4, 0.1), abs=0.02)
    assert found(PeriodicLine(600.0, 0.5, 0.0)) == ()  # below a sixteenth of the sampling rate
    (fast,) = found(PeriodicLine(4_995.0, 0.5, 0.2))
    assert fast.frequency_hz == pytest.approx(4_995.0, abs=1.0)  # no alias beyond half of the sampling rate
    assert line_share(ripple + 3.0, time_s) == pytest.approx(1.0, abs=0.01)
    assert line_share(ripple + 25.0 * math.sqrt(2.0) * noise, time_s) == pytest.approx(0.5, abs=0.06)
    assert line_share(ripple[:63], time_s[:63]) == 0.0


def test_what_steps_hide_of_a_level() -> None:
    """Widrow & Kollar: the bias falls with the noise before rounding, here 0.4 of a step."""
    quantum, full = 0.1, 0.1 / math.sqrt(12.0)
    expected = full * math.exp(-2.0 * (math.pi * 0.4) ** 2)
    assert quantisation_bias(np.empty(0), math.hypot(0.4 * quantum, full), quantum) == pytest.approx(expected)
    noise = 0.4 * quantum * np.random.default_rng(5).standard_normal(50_000)
    quiet = quantum * np.round((0.033 + noise) / quantum)
    assert quantisation_bias(quiet, 9.0, quantum) == pytest.approx(expected, rel=0.05)
    assert quantisation_bias(np.zeros(9), 9.0, quantum) == pytest.approx(full)
