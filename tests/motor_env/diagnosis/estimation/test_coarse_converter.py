"""Starts in a converter's coarse steps: what they hide, and what only looks like a defect."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from simulated_captures import Defect, captures

from motor_env import Recording, Verdict, diagnose, load_motor

# Reaches in: what an alignment finds is told before any fit; the captures take the chain of a sensor.
from motor_env.diagnosis.readers.alignment import align
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.sensor import SensorChain


def start(
    noise: float = 0.0, peak: float = 60.0, rise: float = 30.0, decay: float = 900.0, level: float = 5.0
) -> FloatArray:
    """A start in steps and samples: 1,000 quiet ones, a rise, a decay to a level."""
    after = np.arange(6_000.0)
    shape = np.exp(-after / decay) - np.exp(-after / rise)
    current = np.concatenate(
        [np.zeros(1_000), peak * shape / shape.max() + level * (1.0 - np.exp(-after / rise))]
    )
    return current + noise * np.random.default_rng(4).standard_normal(len(current))


def recording(current_a: FloatArray) -> Recording:
    return Recording(Path("coarse"), np.linspace(0.0, (len(current_a) - 1) * 1e-4, len(current_a)), current_a)


@pytest.mark.parametrize("noise", [0.0, 0.1])
@pytest.mark.parametrize("rise", [3.0, 30.0, 200.0])
def test_a_round_peak_in_coarse_steps_is_not_clipped(rise: float, noise: float) -> None:
    """Its top step lasts long, and it is reached fast: a clipped one is also left fast."""
    current = start(noise, rise=rise)
    assert align(recording(np.round(current))).saturation == ""
    clipped = np.round(np.minimum(current, 0.8 * current.max()))
    assert align(recording(clipped)).saturation != ""


@pytest.mark.parametrize("noise", [0.25, 0.3, 0.4, 0.5])
def test_what_the_steps_hide_of_a_steady_current_is_known(noise: float) -> None:
    """Over all places of the current within a step; the offset of the sensor is in another place each time."""
    rng = np.random.default_rng(5)
    sawtooth = 2.0**-0.5 / math.pi  # its first harmonic
    true_bias = sawtooth * math.exp(-2.0 * (math.pi * noise) ** 2)
    told = [
        align(recording(np.round(start() + offset + noise * rng.standard_normal(7_000)))).unseen_level_a
        for offset in rng.uniform(-0.5, 0.5, 20)
    ]
    assert true_bias < np.median(told) < 2.0 * true_bias
    assert min(told) > 0.5 * true_bias


def test_steps_as_large_as_the_noise_are_no_rectifier() -> None:
    """Both read 0 all through the quiet part; a rectifier in fine steps shows noise wherever the current runs."""
    coarse = align(recording(np.round(start(0.1))))
    assert not coarse.rectified
    thrown_away = np.maximum(np.round(start(0.3) * 20.0) / 20.0, 0.0)
    assert align(recording(thrown_away)).rectified
    below = np.maximum(np.round((start(0.3) - 2.0) * 20.0) / 20.0, 0.0)
    assert align(recording(below)).rectified


@pytest.mark.parametrize("place", [0.0, 0.25, 0.5, 0.625])
def test_rounding_is_no_noise_of_the_motor(place: float) -> None:
    """A data sheet's noise is the sensor's alone; a level at the edge of two steps flips between them."""
    sheet, step = load_motor(Path(__file__).parents[4] / "examples" / "motor.toml"), 0.0125
    chain = SensorChain(offset_a=place * step, range_a=512 * step, adc_bits=10)
    (capture,) = captures(Defect(noise_a=0.25 * step, chain=chain), (), sheet.parameters, 5, 1)
    assert diagnose(capture, replace(sheet, current_noise_a=0.25 * step)).verdict is Verdict.HEALTHY
    (capture,) = captures(Defect(noise_a=0.5 * step), (), sheet.parameters, 5, 1)
    assert diagnose(capture, replace(sheet, current_noise_a=0.25 * step)).verdict is Verdict.NOISE
