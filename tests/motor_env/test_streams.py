"""The random streams: known answers, independence of batches, distribution."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats

from motor_env.parameters import FloatArray
from motor_env.streams import Stream, normals, philox, uniforms


@pytest.mark.parametrize(
    ("counter_and_key", "answer"),
    [
        ((0,) * 6, (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((0xFFFFFFFF,) * 6, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344, 0xA4093822, 0x299F31D0),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ],
)
def test_known_answers_of_philox(counter_and_key: tuple[int, ...], answer: tuple[int, ...]) -> None:
    # The vectors published with Random123 (Salmon et al. 2011).
    assert tuple(int(word) for word in philox(*(np.uint32(word) for word in counter_and_key))) == answer


@pytest.mark.parametrize("draw", [uniforms, normals])
def test_a_case_does_not_depend_on_its_batch(draw: Callable[..., FloatArray]) -> None:
    numbers = draw(3, Stream.MEASUREMENT, [5, 900, 2**40], 101)
    for row, case in zip(numbers, (5, 900, 2**40), strict=True):
        assert np.array_equal(row, draw(3, Stream.MEASUREMENT, [case], 101)[0])
        assert np.array_equal(row[:7], draw(3, Stream.MEASUREMENT, [case], 7)[0])


def test_seed_stream_and_case_each_make_other_numbers() -> None:
    rows = [
        uniforms(seed, stream, [case], 4)[0]
        for seed in (0, 1, 2**32, 2**64 - 1)
        for stream in (Stream.CLASS, Stream.PROCESS)
        for case in (0, 1, 2**32)
    ]
    assert len(np.unique(np.concatenate(rows))) == 4 * len(rows)


def test_uniforms_are_uniform() -> None:
    sample = uniforms(11, Stream.CLASS, np.arange(500), 400).ravel()
    assert 0.0 < sample.min() < sample.max() < 1.0
    assert stats.kstest(sample, "uniform").pvalue > 1e-3


def test_normals_are_normal_and_white() -> None:
    sample = normals(11, Stream.MEASUREMENT, np.arange(500), 400)
    flat, n = sample.ravel(), sample.size
    assert stats.kstest(flat, "norm").pvalue > 1e-3
    # Moments within four standard errors.
    for power, moment, variance in ((1, 0.0, 1.0), (2, 1.0, 2.0), (3, 0.0, 15.0), (4, 3.0, 96.0)):
        assert abs(np.mean(flat**power) - moment) < 4.0 * np.sqrt(variance / n)
    for other in (np.roll(sample, 1, axis=0), np.roll(sample, 1, axis=1), np.roll(sample, 2, axis=1)):
        assert abs(np.mean(sample * other)) < 4.0 / np.sqrt(n)


def test_bad_seed_or_case() -> None:
    with pytest.raises(ValueError, match=r"seed must be in 0 .. 2\^64 - 1, got -1"):
        normals(-1, Stream.CLASS, [0], 1)
    with pytest.raises(ValueError, match="cases must be >= 0, got -3"):
        uniforms(0, Stream.CLASS, [1, -3], 1)
    assert uniforms(0, Stream.CLASS, [], 3).shape == (0, 3)
