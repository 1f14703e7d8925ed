"""The noise: the words of a published generator, and the transform that makes them normal."""

import hashlib

import numpy as np
import pytest

from motor_env.simulation.random_streams import Stream, normals, philox, uniforms


def test_philox_gives_the_published_words() -> None:
    """Known answers of Random123's kat_vectors for philox4x32-10."""
    ones = np.uint32(0xFFFFFFFF)
    zero = np.uint32(0)
    assert philox.py_func is not None
    with np.errstate(over="ignore"):
        assert [int(w) for w in philox(zero, zero, zero, zero, zero, zero)] == [
            0x6627E8D5,
            0xE169C58D,
            0xBC57AC4C,
            0x9B00DBD8,
        ]
        assert [int(w) for w in philox(ones, ones, ones, ones, ones, ones)] == [
            0x408F276D,
            0x41C83B0E,
            0xA20BC7C6,
            0x6D5451FD,
        ]


def test_streams_keep_their_numbers() -> None:
    """A number is part of every seed's meaning: what is drawn from it is in data sets and benchmarks of strangers."""
    names = (
        "class motor supply measurement process onset sensor split wear field_motor field_start severity missing"
        " calibration profile duty recovery"
    )
    assert [stream.name.lower() for stream in Stream] == names.split()
    drawn_from = [*range(9), *range(10, 18)]  # nothing is drawn from number 9 any more
    assert [stream.value for stream in Stream] == drawn_from


@pytest.mark.parametrize("stream", [Stream.CLASS, Stream.DUTY])
def test_uniforms_are_the_words_of_their_counter(stream: Stream) -> None:
    """Key: the seed, lower half first; counter: block, stream, lower and upper half of the case."""
    seed, case = 0x0123456789ABCDEF, 0xFEDCBA9876543
    assert philox.py_func is not None
    for block, four in enumerate(uniforms(seed, stream, [case], 12).reshape(3, 4)):
        counter = block, int(stream), case & 0xFFFFFFFF, case >> 32, seed & 0xFFFFFFFF, seed >> 32
        with np.errstate(over="ignore"):
            words = philox.py_func(*(np.uint32(word) for word in counter))
        assert four.tolist() == [(int(word) + 0.5) / 2**32 for word in words]


def test_normals_never_move_by_a_bit() -> None:
    """Additions, products, roots and shifts of float32 alone, which every processor rounds alike."""
    z = normals(1, Stream.MEASUREMENT, range(64), 1000).astype(np.float32)
    digest = "97f7ec25650bcfd0ebfc5491f19bb43d3d148a14e7d3d1f8b81c498e42078426"
    assert hashlib.sha256(z.tobytes()).hexdigest() == digest


def test_seeds_and_cases_out_of_range_are_refused() -> None:
    assert uniforms(2**64 - 1, Stream.CLASS, [0], 1).shape == (1, 1)
    for seed in (-1, 2**64):
        with pytest.raises(ValueError, match=rf"seed must be in 0 .. 2\^64 - 1, got {seed}"):
            normals(seed, Stream.CLASS, [0], 1)
    with pytest.raises(ValueError, match="cases must be >= 0, got -3"):
        normals(0, Stream.CLASS, [0, -3], 1)


def test_normals_are_the_box_muller_transform_of_the_words() -> None:
    words = (uniforms(5, Stream.MEASUREMENT, range(50), 1000) * 2.0**32 - 0.5).round()
    u, v = (words.reshape(50, -1, 2) + 0.5).transpose(2, 0, 1) * 2.0**-32
    radius = np.sqrt(-2.0 * np.log(u))
    expected = np.stack([radius * np.cos(2.0 * np.pi * v), radius * np.sin(2.0 * np.pi * v)], axis=-1)
    np.testing.assert_allclose(
        normals(5, Stream.MEASUREMENT, range(50), 1000), expected.reshape(50, 1000), atol=1e-5
    )


def test_a_row_does_not_depend_on_its_length_or_neighbours() -> None:
    long = normals(1, Stream.MEASUREMENT, range(20), 1000)
    for count in (1, 3, 5, 255, 256, 257, 999):
        assert np.array_equal(normals(1, Stream.MEASUREMENT, [13], count), long[13:14, :count]), count


def test_cases_beyond_32_bits_have_their_own_numbers() -> None:
    near = normals(1, Stream.MEASUREMENT, [5], 64)
    far = normals(1, Stream.MEASUREMENT, [5 + 2**32], 64)
    assert not np.isin(near, far).any()
