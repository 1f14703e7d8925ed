"""Verdicts on simulated captures, each with one defect of real ones: the table of docs/results/verdicts.md.

python benchmarks/defects.py --starts 60     # four minutes of one core
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from cyclopts import run
from simulated_captures import DEFECTS, captures
from tables import keep_table
from verdict_tables import HERE, Counts, How, Said, counted

from motor_env.diagnosis.diagnose import diagnose
from motor_env.diagnosis.readers.start import Circuit
from motor_env.diagnosis.verdict.judgement import Verdict
from motor_env.motor.data_sheet import load_motor
from motor_env.motor.faults import Fault, FaultKind

CASES: dict[Verdict, tuple[Fault, ...]] = {
    Verdict.HEALTHY: (),
    Verdict.BEARING: (Fault(FaultKind.BEARING, 0.25),),
    Verdict.WINDING: (Fault(FaultKind.WINDING_CONTACT, 0.25),),
}


def judge(number: int, names: Sequence[str], starts: int, seed: int) -> Said:
    """Verdicts on starts with one defect and one fault against the data sheet, and whether the defect was noticed."""
    name, truth = names[number // len(CASES)], list(CASES)[number % len(CASES)]
    motor = load_motor(Path(__file__).parents[1] / "examples" / "motor.toml")
    defect = DEFECTS[name]
    circuit = Circuit(shunt_ohm=defect.shunt_ohm)
    said: Said = []
    for recording in captures(defect, CASES[truth], motor.parameters, seed, starts):
        found = diagnose(recording, motor, circuit=circuit)
        fit = found.decisive.identified
        text = " ".join([*found.recording.columns, *(fit.defects if fit else ()), *found.reasons])
        said += [((name, truth), found.verdict), ((name, "noticed"), str(defect.words in text))]
    return said


def right(name: str, truth: Verdict) -> Verdict:
    """The right verdict; noise above the sheet's is a fault of its own where nothing else is wrong."""
    if not DEFECTS[name].judged:
        return Verdict.UNUSABLE
    return Verdict.NOISE if name == "noise" and truth is Verdict.HEALTHY else truth


def row(name: str, counts: Counts) -> list[str]:
    """Row of the table."""
    found = {truth: counts[name, truth] for truth in CASES}
    cells = [f"{verdicts[right(name, truth)]}/{verdicts.total()}" for truth, verdicts in found.items()]
    noticed = counts[name, "noticed"]
    share = f"{100 * noticed['True'] / noticed.total():.0f} %" if DEFECTS[name].words else "–"
    return [name, *cells, share]


def main(
    *,
    starts: int = 40,
    seed: int = 7,
    defect: Sequence[str] = tuple(DEFECTS),
    how: How = HERE,
) -> None:
    """Print and keep the table.

    Args:
        starts: of each defect and fault.
        seed: of them.
        defect: those of the table.
        how: options of every table.
    """
    of = {"seed": seed, "starts": starts, "defects": list(defect)}
    each = partial(judge, names=tuple(defect), starts=starts, seed=seed)
    counts = counted(each, len(CASES) * len(defect), how, of=of)
    header = ("defect", "healthy", "bearing +25 %", "contact +25 %", "noticed")
    keep_table("verdicts", "defects", header, (row(name, counts) for name in defect))


if __name__ == "__main__":
    run(main)
