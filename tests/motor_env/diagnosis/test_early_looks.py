"""Looks at a motor at work before a window ends."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from motor_env.diagnosis.running.looks import Looks
from motor_env.diagnosis.running.windows import NAMES, WindowJudge, judge_of
from motor_env.fitting import places

# Reaches in: the parts of a window that looks are given are records made by hand.
from motor_env.fitting.record import Record
from motor_env.motor.healthy import Healthy, Windows
from motor_env.motor.parameters import FloatArray

HALVINGS = 4
RATE = 0.05
WINDOWS = Windows(
    window_s=640.0,
    terms=(),
    physical=np.zeros(places.N_VALUES),
    hold="held",
    dt_s=1.0,
    speed_rad_s=1.0,
    excess=(1.0,) * HALVINGS,
)
HEALTHY = Healthy(1000, 1e6, NAMES, np.ones(4), np.eye(4) * 1e-12, temperature_k=0.0, windows=WINDOWS)
LOOKS = Looks(judge_of(HEALTHY), RATE, np.zeros(4))
SPREAD = 0.1  # of one block's logarithms


def record(values: FloatArray) -> Record:
    return Record(1.0, values, np.zeros((len(values), 2)), np.ones(2), np.zeros(len(values)))


def means(_: WindowJudge, parts: list[Record], at: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Instead of a motor: the logarithms of a part are the means of white noise."""
    for part in parts:
        n = len(part.voltage_v)
        yield part.voltage_v.mean(axis=0), np.eye(4) * SPREAD**2 / n


def looked(looks: Looks, blocks: FloatArray) -> list[tuple[int, str]]:
    """Block of each look at the second window of a stream that alarms, and the verdict."""
    window, found = len(blocks) // 2, []
    for number in range(1, window):
        due = looks.due(number)
        parts = [record(blocks[: window + number][-window // 2**k :]) for k in due]
        found += [(number, str(one.verdict)) for one in looks.judgements(parts, due) if one is not None]
    return found


def test_each_length_is_looked_at_whenever_a_quarter_of_it_is_new() -> None:
    assert LOOKS.every_s == 640.0 / 16 / 4
    assert [LOOKS.due(n) for n in (1, 2, 3, 4, 8)] == [[4], [3, 4], [4], [2, 3, 4], [1, 2, 3, 4]]
    assert (LOOKS.needed_s(1), LOOKS.needed_s(4)) == (320.0, 42.0)


def test_looks_alarm_at_the_wanted_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(WindowJudge, "first_steps", means)
    rng, windows = np.random.default_rng(19), 300
    alarms = sum(
        bool(looked(LOOKS, SPREAD * rng.standard_normal((2 * 4 * 2**HALVINGS, 4)))) for _ in range(windows)
    )
    assert 6 <= alarms <= 28  # 1 to 99.9 % of a Poisson number about 15


def test_a_fault_is_seen_and_named_long_before_the_window_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(WindowJudge, "first_steps", means)
    blocks = SPREAD * np.random.default_rng(19).standard_normal((128, 4))
    blocks[64 + 10 :, 3] += np.log(1.5)
    (number, verdict), *_ = looked(LOOKS, blocks)
    assert 10 < number <= 16
    assert verdict == "bearing"


def nearing(_: WindowJudge, parts: list[Record], at: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    """A motor of which a step tells 0.3 of a change of R, and takes some of the rest for one of J."""
    for truth, spread in means(_, parts, at):
        rest = 0.7 * (at[0] - truth[0])
        yield truth + rest * np.array([1.0, 0.0, 0.6, 0.0]), spread


def test_a_large_fault_is_named_where_the_steps_settle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(WindowJudge, "first_steps", nearing)
    blocks = SPREAD * np.random.default_rng(19).standard_normal((128, 4))
    blocks[64:, 0] += np.log(1.6)
    verdicts = {verdict for number, verdict in looked(LOOKS, blocks) if number > 32}
    assert verdicts == {"winding"}


def test_without_what_a_commissioning_teaches_there_are_no_looks() -> None:
    untaught = judge_of(replace(HEALTHY, windows=replace(WINDOWS, excess=())))
    assert replace(LOOKS, judge=untaught).every_s == np.inf
