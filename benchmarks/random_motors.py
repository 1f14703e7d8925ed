"""Verdicts on motors of all sizes, each known by five healthy starts, or by a data sheet (docs/results/verdicts.md).

python benchmarks/random_motors.py --motors 60     # two minutes of one core
"""

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
from cyclopts import run
from tables import keep_table
from verdict_tables import HERE, How, Said, counted, verdict_names, words_of

from motor_env.diagnosis.diagnose import Diagnosis, diagnose
from motor_env.diagnosis.readers.recording import Recording
from motor_env.diagnosis.readers.start import prepare
from motor_env.diagnosis.verdict.healthy_motor import to_motor
from motor_env.diagnosis.verdict.healthy_spread import fit_healthy, learn_starts
from motor_env.diagnosis.verdict.judgement import Verdict
from motor_env.motor.data_sheet import Motor
from motor_env.motor.parameters import FloatArray, MotorParameters, SensorParameters, SupplyParameters
from motor_env.simulation.fast_path import measure
from motor_env.simulation.nonlinear import Effects
from motor_env.simulation.sensor import SensorChain
from motor_env.simulation.simulate import Scenario, Timing

BY_STARTS, BY_SHEET = "by five healthy starts", "by its data sheet"
FRICTION = 1.5
CHANGES: dict[str, dict[str, float]] = {
    "healthy": {},
    "healthy, once more": {},
    "contact +25 %": {"resistance_ohm": 1.25},
    "friction +50 %": {"friction": FRICTION},
    "K -10 %": {"back_emf_constant_v_s_per_rad": 0.9, "torque_constant_n_m_per_a": 0.9},
    "J +25 %": {"inertia_kg_m2": 1.25},
    "contact × 2": {"resistance_ohm": 2.0},
    "friction × 3": {"friction": 3.0},
    "friction × 6": {"friction": 6.0},
}
HEALTHY = 5
Changes = Mapping[str, Mapping[str, float]]


def starts(rng: np.random.Generator, changes: Changes = CHANGES) -> tuple[list[Recording], Motor]:
    """The healthy starts of one motor and then one with each change, recorded by one sensor; and its data sheet."""
    names = [f"healthy {n}" for n in range(HEALTHY)] + list(changes)

    def scattered(spread: float, name: str) -> FloatArray:
        """A factor for each start: its scatter, and the change of the last ones."""
        changed = [changes.get(each, {}).get(name, 1.0) for each in names]
        factors: FloatArray = (1.0 + spread * rng.standard_normal(len(names))) * np.array(changed)
        return factors

    voltage = float(rng.choice([3.0, 6.0, 12.0, 24.0, 48.0]))
    stall_a = 10.0 ** rng.uniform(-0.5, 1.7)
    speed = 10.0 ** rng.uniform(2.0, 3.0)
    mechanical_s = 10.0 ** rng.uniform(-2.2, -0.6)
    electrical_s = mechanical_s / 10.0 ** rng.uniform(0.9, 2.2)
    ohm, constant = voltage / stall_a, 0.97 * voltage / speed
    torque = constant * stall_a * rng.uniform(0.01, 0.06)
    dry = rng.choice([0.0, rng.uniform(0.0, 1.0)])
    friction = scattered(0.02, "friction")
    motor = MotorParameters(
        resistance_ohm=ohm,
        inductance_h=electrical_s * ohm,
        back_emf_constant_v_s_per_rad=constant,
        torque_constant_n_m_per_a=constant,
        inertia_kg_m2=mechanical_s * constant**2 / ohm,
        viscous_friction_n_m_s_per_rad=(1.0 - dry) * torque / speed,
    )
    each = motor.scaled(
        resistance_ohm=scattered(0.005, "resistance_ohm"),
        back_emf_constant_v_s_per_rad=scattered(0.0, "back_emf_constant_v_s_per_rad"),
        torque_constant_n_m_per_a=scattered(0.0, "torque_constant_n_m_per_a"),
        inertia_kg_m2=scattered(0.0, "inertia_kg_m2"),
        inductance_h=np.array([changes.get(name, {}).get("inductance_h", 1.0) for name in names]),
        viscous_friction_n_m_s_per_rad=friction,
    )
    duration_s = mechanical_s * rng.uniform(4.0, 10.0)
    rate_hz = float(rng.choice([400, 1_000, 2_500, 10_000])) / duration_s
    timing = Timing(rate_hz, duration_s, duration_s * rng.uniform(0.05, 0.4))
    delay_s = rng.uniform(0.0, 1.0, len(names)) / rate_hz
    drop_v = float(rng.choice([0.0, 0.0, 0.03])) * voltage
    sheet = Motor(
        "this motor",
        "data_sheet",
        motor,
        nominal_voltage_v=voltage,
        coulomb_friction_n_m=float(dry * torque),
        brush_drop_v=drop_v,
    )
    effects = Effects(
        coulomb_friction_n_m=dry * torque * friction,
        brush_drop_v=drop_v,
        ramp_s=float(rng.choice([0.0, 0.0, rng.uniform(0.2, 2.0)])) * electrical_s,
        commutation_ripple=float(rng.choice([0.0, 0.01, 0.03])),
        commutation_per_turn=float(rng.choice([6.0, 10.0, 14.0, 26.0])),
        delay_s=delay_s,
    )
    bits = int(rng.choice([0, 8, 10, 12]))
    chain = SensorChain(
        offset_a=float(rng.choice([0.0, 0.02])) * stall_a, range_a=2.0 * stall_a, adc_bits=bits
    )
    supply = voltage * (1.0 + 0.005 * rng.standard_normal(len(names)))
    scenario = Scenario(
        each,
        (),
        SupplyParameters(supply),
        SensorParameters(current_noise_a=stall_a * 10.0 ** rng.uniform(-3.0, -2.0)),
        timing,
    )
    seed = int(rng.integers(2**32))
    current = measure(scenario, seed, range(len(names)), effects=effects, chain=chain, nominal=motor)[:, 0]
    # Half of the steps come with their voltage, which some scopes read a sample later than the current.
    measured = not effects.ramp_s and rng.random() < 0.5
    on = timing.time_s > (delay_s + float(rng.choice([0.0, 1.0])) / rate_hz)[:, None]
    volts = supply[:, None] * on + 0.002 * voltage * rng.standard_normal(on.shape)
    recordings = [
        Recording(Path(name), timing.time_s, row.astype(np.float64), volts[n] if measured else None)
        for n, (name, row) in enumerate(zip(names, current, strict=True))
    ]
    return recordings, sheet


def said(found: Diagnosis) -> str:
    """The verdict; where a change of friction was missed also whether the diagnosis had said that it might not show."""
    missed = found.recording.path.name == "friction +50 %" and found.verdict is Verdict.HEALTHY
    stated = missed and found.decisive.smallest_changes["bearing"] > FRICTION - 1.0
    return f"{found.verdict} (+50 % might not show, it said)" if stated else verdict_names(found)


def judge(number: int, seed: int) -> Said:
    """Verdicts on the starts of one motor, by what has changed."""
    recordings, sheet = starts(np.random.default_rng([seed, number]))
    fits = fit_healthy([prepare(each) for each in recordings[:HEALTHY]])
    known = {BY_STARTS: to_motor(fits, "this motor", healthy=learn_starts(fits)), BY_SHEET: sheet}
    return [
        ((r.path.name, by), said(diagnose(r, motor)))
        for r in recordings[HEALTHY:]
        for by, motor in known.items()
    ]


def main(*, motors: int = 60, seed: int = 0, how: How = HERE) -> None:
    """Judge motors and keep the table.

    Args:
        motors: how many.
        seed: of them.
        how: options of every table.
    """
    counts = counted(partial(judge, seed=seed), motors, how, of={"seed": seed})
    rows = ([name, *(words_of(counts[(name, by)]) for by in (BY_STARTS, BY_SHEET))] for name in CHANGES)
    keep_table("verdicts", "random motors", ("one start with", BY_STARTS, BY_SHEET), rows)


if __name__ == "__main__":
    run(main)
