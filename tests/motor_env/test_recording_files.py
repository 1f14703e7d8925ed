from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from motor_env import cli
from motor_env.console import InputError
from motor_env.motor_file import load_motor
from motor_env.recordings import ColumnChoice, read_recording, understand

TIME = np.linspace(0.0, 0.049, 50)
CURRENT = np.sin(50.0 * TIME) + 1.0
SPEED = 100.0 * TIME
EXAMPLES = Path(__file__).parents[2] / "examples"


def write(path: Path, text: str, encoding: str = "utf-8") -> Path:
    path.write_bytes(text.encode(encoding))
    return path


def check(path: Path, *columns: str) -> None:
    recording = read_recording(path, [ColumnChoice.parse(column) for column in columns])
    np.testing.assert_allclose(recording.time_s, TIME, atol=1e-9)
    np.testing.assert_allclose(recording.current_a, CURRENT, atol=1e-4)
    if recording.speed_rad_s is not None:
        np.testing.assert_allclose(recording.speed_rad_s, SPEED, atol=1e-3)


def test_semicolons_decimal_comma_and_units(tmp_path: Path) -> None:
    rows = (
        f"{1e3 * t:.3f};{1e3 * i:.3f};{s / (2.0 * np.pi) * 60.0:.4f}".replace(".", ",")
        for t, i, s in zip(TIME, CURRENT, SPEED, strict=True)
    )
    check(write(tmp_path / "a.csv", "Zeit (ms);Strom (mA);Drehzahl (rpm)\n" + "\n".join(rows)))


def test_a_scope_with_a_preamble_and_a_row_of_units(tmp_path: Path) -> None:
    rows = (f"{t:.6f},{i:.6f}" for t, i in zip(TIME, CURRENT, strict=True))
    text = "Model,X1\nDate,today\nTime Base,1 ms\n\nX-axis,CH1\ns,A\n" + "\n".join(rows)
    check(write(tmp_path / "a.csv", text))


def test_a_scope_with_its_settings_beside_the_data(tmp_path: Path) -> None:
    rows = (
        (f"Setting {n},{n}," if n < 15 else ",,") + f"Points,{t:.6f},{i:.6f}"
        for n, (t, i) in enumerate(zip(TIME, CURRENT, strict=True))
    )
    check(write(tmp_path / "a.csv", "\n".join(rows)))


def test_tabs_micro_signs_and_old_code_pages(tmp_path: Path) -> None:
    rows = (f"{1e6 * t:.2f}\t{1e3 * i:.4f}" for t, i in zip(TIME, CURRENT, strict=True))
    check(write(tmp_path / "a.txt", "Time [µs]\tCurrent [mA]\n" + "\n".join(rows), "cp1252"))


def test_columns_named_by_the_user(tmp_path: Path) -> None:
    rows = "\n".join(f"{t:.6f},{1e3 * i:.4f}" for t, i in zip(TIME, CURRENT, strict=True))
    path = write(tmp_path / "a.csv", "time_s,CH1\n" + rows)
    check(path, "current=CH1:mA")
    check(path, "current=2:mA")
    with pytest.raises(InputError, match="current_a is missing"):
        read_recording(path)
    with pytest.raises(InputError, match="there is no column CH9"):
        read_recording(path, [ColumnChoice.parse("current=CH9")])


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
    with pytest.raises(InputError, match="is not a NumPy file that can be read"):
        read_recording(tmp_path / "a.npy")


@pytest.mark.parametrize(
    ("header", "quantity", "factor"),
    [
        ("time_s", "time", 1.0),
        ("t_us", "time", 1e-6),
        ("I (mA)", "current", 1e-3),
        ("speed_rad_s", "speed", 1.0),
        ("n [1/min]", "speed", 2.0 * np.pi / 60.0),
        ("Speed in deg/s", "speed", np.pi / 180.0),
        ("CH2 (V)", "voltage", 1.0),
        ("duty", "duty", 1.0),
        ("temperature", None, 1.0),
    ],
)
def test_headers(header: str, quantity: str | None, factor: float) -> None:
    found, scale = understand(header)
    assert found == quantity
    assert scale == pytest.approx(factor)


def sentence_about(path: Path) -> str | None:
    try:
        read_recording(path)
    except InputError as error:
        return str(error)
    return None


def test_damaged_files_get_one_sentence_each(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Random damage: no traceback, and what cannot be read gets one sentence that names the file."""
    good = (EXAMPLES / "startup_capture.csv").read_bytes()[:8000].rsplit(b"\n", 1)[0]
    rng, refused = np.random.default_rng(3), 0
    for n in range(60):
        damaged = bytearray(good)
        place = int(rng.integers(30, len(good)))
        damage = (b"nan", b"\0", b'"', b",,", b"x", b"1e999", b"\n\n-", rng.bytes(20))[n % 8]
        damaged[place:place] = damage
        if n % 5 == 0:
            damaged = damaged[: place // 8]
        path = tmp_path / f"f{n}{('.csv', '.mat', '.npy', '.npz', '.txt')[n % 5]}"
        path.write_bytes(bytes(damaged))
        sentence = sentence_about(path)
        if sentence is not None:
            refused += 1
            assert path.name in sentence
            assert "\n" not in sentence
    assert refused > 30
    empty = write(tmp_path / "empty.csv", "")
    assert cli.main(["diagnose", str(empty)]) == 2
    assert capsys.readouterr().err.strip().endswith("empty.csv: is empty")


def test_identify_writes_a_motor_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "m.toml"
    assert cli.main(["identify", str(EXAMPLES / "startup_capture.csv"), "-o", str(target)]) == 0
    assert "K down looks like J and B up" in capsys.readouterr().out
    motor = load_motor(target)
    assert motor.kind == "identified"
    assert motor.parameters.resistance_ohm == pytest.approx(2.18, rel=0.01)


def test_commission_needs_three_starts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status = cli.main(["commission", str(EXAMPLES / "startup_capture.csv"), "-o", str(tmp_path / "m.toml")])
    assert status == 2
    assert "at least 3 healthy starts, got 1" in capsys.readouterr().err
    assert not (tmp_path / "m.toml").exists()


def test_commissioned_motor_judges_its_own_starts(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    table = np.loadtxt(EXAMPLES / "startup_capture.csv", delimiter=",", skiprows=1)
    paths = []
    for n in range(4):
        noisy = table.copy()
        noisy[:, 2] += 0.01 * rng.standard_normal(len(table))
        path = tmp_path / f"start_{n}.csv"
        np.savetxt(path, noisy, delimiter=",", header="time_s,voltage_v,current_a", comments="")
        paths.append(str(path))
    target = str(tmp_path / "m.toml")
    assert cli.main(["commission", *paths[:3], "-o", target]) == 0
    assert cli.main(["diagnose", paths[3], "--motor", target]) == 0
    weaker = np.loadtxt(paths[3], delimiter=",", skiprows=1)
    weaker[:, 2] *= 0.8
    np.savetxt(paths[3], weaker, delimiter=",", header="time_s,voltage_v,current_a", comments="")
    assert cli.main(["diagnose", paths[3], "--motor", target]) == 1
