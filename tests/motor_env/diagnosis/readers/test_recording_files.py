from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hostile import Poison, refused
from recording_csv import csv_text, write_csv
from scipy.io import savemat

from motor_env import ColumnChoice, InputError, Recording, cli, load_motor, read_recording
from motor_env.diagnosis.readers.recording import describe_reading

TIME = np.linspace(0.0, 0.049, 50)
CURRENT = np.sin(50.0 * TIME) + 1.0
SPEED = 100.0 * TIME
START = Path(__file__).parents[4] / "examples" / "startup_capture.csv"


def check(path: Path, *columns: str) -> None:
    recording = read_recording(path, [ColumnChoice.parse(column) for column in columns])
    np.testing.assert_allclose(recording.time_s, TIME, atol=1e-9)
    np.testing.assert_allclose(recording.current_a, CURRENT, atol=1e-4)
    if recording.speed_rad_s is not None:
        np.testing.assert_allclose(recording.speed_rad_s, SPEED, atol=1e-3)


SCOPE = csv_text({"X-axis": TIME, "CH1": CURRENT}, form=".6f").split("\n", 1)


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        pytest.param(
            csv_text(
                {"Zeit (ms)": 1e3 * TIME, "Strom (mA)": 1e3 * CURRENT, "Drehzahl (rpm)": 30.0 * SPEED / np.pi},
                form=".4f", mark=";", decimal=",",
            ),
            "utf-8",
            id="semicolons, decimal commas and units",
        ),
        pytest.param(
            f"Model,X1\nDate,today\nTime Base,1 ms\n\n{SCOPE[0]}\ns,A\n{SCOPE[1]}",
            "utf-8",
            id="a scope with a preamble and a row of units",
        ),
        pytest.param(
            "\n".join(
                (f"Setting {n},{n}," if n < 15 else ",,") + f"Points,{row}"
                for n, row in enumerate(SCOPE[1].splitlines())
            ),
            "utf-8",
            id="a scope with its settings beside the data",
        ),
        pytest.param(
            csv_text({"Time [µs]": 1e6 * TIME, "Current [mA]": 1e3 * CURRENT}, form=".4f", mark="\t"),
            "cp1252",
            id="tabs, micro signs and old code pages",
        ),
    ],
)  # fmt: skip
def test_text(text: str, encoding: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(text.encode(encoding))
    check(tmp_path / "a.csv")


def test_columns_named_by_the_user(tmp_path: Path) -> None:
    path = write_csv(tmp_path / "a.csv", {"time_s": TIME, "CH1": 1e3 * CURRENT}, form=".6f")
    check(path, "current=CH1:mA")
    check(path, "current=2:mA")
    assert "current_a is missing" in refused(lambda: read_recording(path), path)
    chosen = [ColumnChoice.parse("current=CH9")]
    assert "there is no column CH9" in refused(lambda: read_recording(path, chosen), path)


@pytest.mark.parametrize("column", ["current=none", "voltage=current_a*12", "voltage=2:V*12"])
def test_a_recording_without_its_current_is_refused(column: str, tmp_path: Path) -> None:
    path = write_csv(tmp_path / "a.csv", {"time_s": TIME, "current_a": CURRENT}, form=".6f")
    sentence = refused(lambda: read_recording(path, [ColumnChoice.parse(column)]), path)
    assert "the column current_a is missing, found 'time_s', 'current_a'" in sentence


@pytest.mark.parametrize("scale", ["0", "0.0", "-0e5"])
def test_a_column_is_not_divided_by_zero(scale: str) -> None:
    with pytest.raises(InputError, match="--column must read QUANTITY=COLUMN"):
        ColumnChoice.parse(f"current=CH2/{scale}")


def test_binary_files(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", {"t": TIME, "current": CURRENT, "omega": SPEED})
    np.savez(tmp_path / "a.npz", time_s=TIME, current_a=CURRENT)
    np.save(tmp_path / "a.npy", np.column_stack([TIME, CURRENT]))
    for name in ("a.mat", "a.npz", "a.npy"):
        check(tmp_path / name)


def test_parquet(tmp_path: Path) -> None:
    pa = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    parquet.write_table(pa.table({"time_s": TIME, "current_a": CURRENT}), tmp_path / "a.parquet")
    check(tmp_path / "a.parquet")


def test_a_pickle_in_a_numpy_file_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([{}], dtype=object), allow_pickle=True)
    np.save(tmp_path / "b.npy", np.array([Poison(tmp_path / "mark")], dtype=object), allow_pickle=True)
    for path in (tmp_path / "a.npy", tmp_path / "b.npy"):
        assert "is not a NumPy file that can be read" in refused(partial(read_recording, path), path)
    assert not (tmp_path / "mark").exists()


def test_a_folder_without_a_recording_has_no_trend(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for n, content in enumerate((b"", b"PAR1 nothing", b"time_s,current_a\n0,1\n", b"\0" * 99), 1):
        (tmp_path / f"2026-01-{n:02d}.csv").write_bytes(content)
    assert cli.main(["trend", str(tmp_path), "--out", str(tmp_path / "t.html")]) == 2
    said = capsys.readouterr().err
    assert said.startswith("motor-env: no recording can be used; the first reason: ")
    assert said.endswith("2026-01-01.csv: is empty\n")
    assert not (tmp_path / "t.html").exists()


def test_identify_writes_a_motor_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "m.toml"
    assert cli.main(["identify", str(START), "-o", str(target)]) == 0
    assert "K down looks like J and B up" in capsys.readouterr().out
    motor = load_motor(target)
    assert motor.kind == "identified"
    assert motor.parameters.resistance_ohm == pytest.approx(2.18, rel=0.01)


def test_files_that_were_read_in_different_ways_are_told_apart() -> None:
    files = [(Path(f"{n}.csv"), (f"current is column {n // 2}", f"{n} samples")) for n in range(9)]
    assert describe_reading(files[:2]) == ["  read: current is column 0"]
    assert describe_reading(files) == [
        "  read: 0.csv and 1 more: current is column 0",
        "  read: 2.csv and 1 more: current is column 1",
        "  read: 4.csv and 1 more: current is column 2",
        "  read: other files in 2 more ways",
    ]
    assert describe_reading([(Path("a.csv"), ())]) == []


def test_commission_needs_three_starts(tmp_path: Path) -> None:
    words = ["commission", str(START), "-o", str(tmp_path / "m.toml")]
    assert "at least 3 healthy starts, got 1" in refused(
        lambda: cli.main(words), tmp_path / "m.toml", named=False
    )


def test_commissioned_motor_judges_its_own_starts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(8)
    time_s, volts, current = np.loadtxt(START, delimiter=",", skiprows=1).T
    columns = {"time_s": time_s, "voltage_v": volts}
    noisy = [current + 0.01 * rng.standard_normal(len(current)) for _ in range(4)]
    *healthy, judged = (
        str(write_csv(tmp_path / f"start_{n}.csv", columns | {"current_a": one}))
        for n, one in enumerate(noisy)
    )
    target = str(tmp_path / "m.toml")
    assert cli.main(["commission", *healthy, "-o", target]) == 0
    describe_reading = (
        "time is column 1 (time_s); current is column 3 (current_a); voltage is column 2 (voltage_v)"
    )
    assert [line for line in capsys.readouterr().out.splitlines() if "read: " in line] == [
        f"  read: {describe_reading}"
    ]
    assert cli.main(["diagnose", judged, "--motor", target]) == 0
    write_csv(Path(judged), columns | {"current_a": 0.8 * noisy[3]})
    assert cli.main(["diagnose", judged, "--motor", target]) == 1


def test_what_contradicts_the_header_is_warned_of(tmp_path: Path) -> None:
    columns = {"time_s": TIME, "CLAMP (mV)": np.rint(500.0 * CURRENT), "T_case": 20.0 + np.arange(50) % 2}
    path = write_csv(tmp_path / "a.csv", columns, form=".6g")

    def read(column: str) -> Recording:
        return read_recording(path, [ColumnChoice.parse(column)])

    (sentence,) = read("current=CLAMP:A").warnings
    assert "the header of column CLAMP (mV) says mV, and --column says A" in sentence
    assert f"gives a current of {np.rint(500.0 * CURRENT).max():.4g} A" in sentence
    assert read("current=CLAMP*10").warnings == ()
    assert "not used: T_case" in read("current=CLAMP*10").columns
    path.write_text(path.read_text(encoding="utf-8").replace(" (mV)", ""), encoding="utf-8")
    assert "whole numbers, as a converter's counts" in read("current=CLAMP:A").warnings[0]
    assert read("current=CLAMP:mA").warnings == ()
