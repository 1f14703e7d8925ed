"""20 kHz from a pipe: the share of one core that `motor-env watch` needs; `pytest -m long -s` prints it."""

import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from motor_env import PAPER_MOTOR, Motor, discretize
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.terms import NOISES

# Reaches in: what windows teach is written by hand, without the long fits of a commissioning at work.
from motor_env.diagnosis.operation.windows import viscous
from motor_env.diagnosis.verdict.hypotheses import NAMES
from motor_env.motor.data_sheet import save_motor
from motor_env.motor.healthy import Healthy, Windows

RATE_HZ, WINDOW_S, STREAM_S = 20_000, 5.0, 60.1
SPEED_RAD_S = 250.0
TERMS = ("R", "K", "J", "coulomb", "load_constant", "load_square", "offset_current", "offset_speed", *NOISES)


def healthy() -> Healthy:
    """As the textbook motor would have taught it."""
    motor = PAPER_MOTOR
    physical = np.zeros(index.N_VALUES)
    physical[[index.R, index.L, index.K, index.J, index.B]] = (
        motor.resistance_ohm,
        motor.inductance_h,
        motor.torque_constant_n_m_per_a,
        motor.inertia_kg_m2,
        motor.viscous_friction_n_m_s_per_rad,
    )
    physical[[index.NOISE_I, index.NOISE_W, index.NOISE_V]] = 0.003, 0.2, 0.01
    # So that a sample in which the motor turns costs its events.
    physical[[index.COULOMB, index.DROP]] = 1e-6, 1e-3
    averaged = 17  # 100,000 samples of a window as at most 6,000
    windows = Windows(
        window_s=WINDOW_S,
        terms=TERMS,
        physical=physical,
        hold="straight",
        dt_s=averaged / RATE_HZ,
        speed_rad_s=SPEED_RAD_S,
        rms_volts=(5.0, 9.0),
    )
    drag = viscous(physical, SPEED_RAD_S)
    return Healthy(
        pieces=10,
        degrees_of_freedom=13.0,
        quantities=NAMES,
        values=np.array([*physical[[index.R, index.K, index.J]], drag]),
        log_covariance=np.eye(4) * 1e-3,
        windows=windows,
    )


def stream() -> bytes:
    """What a device prints of the motor under a voltage that changes every 0.1 s."""
    model, n, rng = discretize(PAPER_MOTOR, 1.0 / RATE_HZ), int(STREAM_S * RATE_HZ), np.random.default_rng(1)
    volts = np.repeat(rng.uniform(-12.0, 12.0, n // 2_000 + 1), 2_000)[:n]
    states = []
    (a, b), (c, d) = model.transition.tolist()
    (g, _), (h, _) = model.gain.tolist()
    i = w = 0.0
    for v in volts.tolist():
        i, w = a * i + b * w + g * v, c * i + d * w + h * v
        states.append((i, w))
    x = np.array(states) + rng.standard_normal((n, 2)) * (0.02, 1.0)
    rows = zip((np.arange(n) / RATE_HZ).tolist(), volts.tolist(), *x.T.tolist(), strict=True)
    return b"time_s,voltage_v,current_a,speed_rad_s\n" + b"".join(
        b"%.5f,%.4g,%.4g,%.5g\n" % row for row in rows
    )


@pytest.mark.long
@pytest.mark.timeout(600)
def test_20_khz_needs_less_than_half_a_core(tmp_path: Path) -> None:
    toml = tmp_path / "motor.toml"
    save_motor(replace(Motor("textbook", "commissioned", PAPER_MOTOR), healthy=healthy()), toml)
    lines = stream()

    def cpu_s(data: bytes) -> tuple[float, str]:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        command = [sys.executable, "-m", "motor_env", "watch", str(toml)]
        done = subprocess.run(command, input=data, capture_output=True, check=False)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, done.stdout.decode()

    begin_s, _ = cpu_s(lines[:200])
    whole_s, told = cpu_s(lines)
    share = (whole_s - begin_s) / STREAM_S
    sys.stdout.write(f"begin {begin_s:.1f} s of CPU, then {share:.2f} of a core\n{told}")
    assert told.count('"healthy"') == 12
    assert share < 0.5
