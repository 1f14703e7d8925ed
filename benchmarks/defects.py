"""Verdicts on simulated captures, each with one defect of real ones: the table of docs/recordings.md.

python benchmarks/defects.py --starts 40
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from cyclopts import run
from simulated_captures import DEFECTS, captures

from motor_env.diagnosis.decision import Diagnosis, Verdict
from motor_env.diagnosis.diagnose import diagnose
from motor_env.motor.data_sheet import load_motor
from motor_env.motor.faults import Fault, FaultKind
from motor_env.recordings.start import Circuit

CASES: dict[Verdict, tuple[Fault, ...]] = {
    Verdict.HEALTHY: (),
    Verdict.BEARING: (Fault(FaultKind.BEARING, 0.25),),
    Verdict.WINDING: (Fault(FaultKind.WINDING_CONTACT, 0.25),),
}


def diagnose_all(name: str, truth: Verdict, starts: int, seed: int) -> list[Diagnosis]:
    """Diagnoses of starts with a defect and a fault, against the data sheet."""
    motor = load_motor(Path(__file__).parents[1] / "examples" / "motor.toml")
    defect = DEFECTS[name]
    circuit = Circuit(shunt_ohm=defect.shunt_ohm)
    recordings = captures(defect, CASES[truth], motor.parameters, seed, starts)
    return [diagnose(recording, motor, circuit=circuit) for recording in recordings]


def is_right(name: str, truth: Verdict, found: Diagnosis) -> bool:
    """Whether a verdict is right; noise above the sheet's is a fault of its own where nothing else is wrong."""
    if not DEFECTS[name].judged:
        return found.verdict is Verdict.UNUSABLE
    if name == "noise" and truth is Verdict.HEALTHY:
        return found.verdict is Verdict.NOISE
    return found.verdict is truth


def main(*, starts: int = 40, seed: int = 7, defect: Sequence[str] = tuple(DEFECTS)) -> None:
    """Print the table."""
    print("| defect | healthy | bearing +25 % | contact +25 % | noticed | wrong verdicts |")
    print("|---|---|---|---|---|---|")
    for name in defect:
        cells, wrong, noticed, total = [], Counter[str](), 0, 0
        for truth in CASES:
            found = diagnose_all(name, truth, starts, seed)
            good = [is_right(name, truth, diagnosis) for diagnosis in found]
            cells.append(f"{sum(good)}/{len(good)}")
            wrong.update(f"{truth}: {d.verdict}" for d, ok in zip(found, good, strict=True) if not ok)
            told = [
                " ".join(
                    [*d.recording.columns, *(map(str, d.identified.defects) if d.identified else d.reasons)]
                )
                for d in found
            ]
            noticed += sum(DEFECTS[name].words in text for text in told)
            total += len(found)
        share = f"{100 * noticed / total:.0f} %" if DEFECTS[name].words else "–"
        reasons = ", ".join(f"{words} {count}" for words, count in wrong.items()) or "–"
        print(f"| {name} | {' | '.join(cells)} | {share} | {reasons} |", flush=True)


if __name__ == "__main__":
    run(main)
