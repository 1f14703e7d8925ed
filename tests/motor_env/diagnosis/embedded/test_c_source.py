"""The exported C source, compiled: bit-equal to its twin, free of warnings; tools that are missing skip.

The compilers, sanitizers and CMake take long: `pytest -m long`.
"""

import ctypes
import itertools
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from real_parts import installed

from motor_env import PAPER_MOTOR, Channel, Fault, FaultKind, Motor, Scenario, SensorParameters, simulate
from motor_env.diagnosis.embedded.monitor import CusumBank, Monitor, monitor_of
from motor_env.diagnosis.embedded.source import write_library
from motor_env.diagnosis.embedded.twin import (
    Numbers,
    TwinResult,
    fixed_point,
    floating,
    readings_of,
    run_twin,
)

pytestmark = pytest.mark.timeout(900)
WARNINGS = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror"]
SHARED = ["-O2", "-ffp-contract=off", "-shared", "-fPIC"]
SANITIZERS = ["-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
RUN = """
#include "m.h"
void run(long cases, long count, const m_sample *samples, int *verdicts, m_number *statistics)
{
    long n, k;
    for (n = 0; n < cases; ++n) {
        m monitor;
        m_init(&monitor);
        for (k = 0; k < count; ++k) {
            *verdicts++ = (int)m_step(&monitor, *samples++);
            *statistics++ = monitor.statistic;
        }
    }
}
"""
HOSTILE = """
#include <limits.h>
int main(void)
{
    static const m_number EDGES[] = {EDGE_VALUES};
    static m_sample samples[20000];
    static int verdicts[20000];
    static m_number statistics[20000];
    unsigned seed = 1, k, c;
    for (k = 0; k < 20000; ++k) {
        m_number values[sizeof(m_sample) / sizeof(m_number)];
        for (c = 0; c < sizeof values / sizeof *values; ++c) {
            seed = seed * 1664525u + 1013904223u;
            values[c] = EDGES[(seed >> 16) % (sizeof EDGES / sizeof *EDGES)];
        }
        samples[k] = *(m_sample *)values;
    }
    run(1, 20000, samples, verdicts, statistics);
    return m_self_test();
}
"""
EDGES = {
    "fixed": "0, 1, -1, 5000000, -5000000, 11000000, -11000000, 24000000, -24000000, INT32_MAX, INT32_MIN",
    "float": "0.0f, 1.0f, -5.0f, 11.0f, -11.0f, 24.0f, -24.0f, 3e38f, -3e38f, 0.0f / 0.0f, 1.0f / 0.0f",
}
BUILDS = list(itertools.product(("fixed", "float"), (1, 2)))


def compiled(command: list[str | Path]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def exported(folder: Path, arithmetic: str, n_channels: int) -> tuple[Monitor, Numbers]:
    believed = monitor_of(
        Motor("paper */ \\", "data_sheet", PAPER_MOTOR, brush_drop_v=0.1 * (n_channels - 1)),
        10_000.0,
        rule=CusumBank(),
        sensor=SensorParameters((Channel.CURRENT, Channel.SPEED)[:n_channels], 0.02, 1.0),
        voltage_v=12.0,
    )
    steps = believed.limits.counts() if arithmetic == "fixed" else None
    write_library(believed, folder, steps=steps, name="m", wanted="1 false alarm a year")
    (folder / "run.c").write_text(RUN, encoding="utf-8")
    return believed, fixed_point(believed, steps) if steps else floating(believed)


def run_c(folder: Path, readings: NDArray[Any]) -> TwinResult:
    library = folder / "run.so"
    sources = [*folder.glob("src/*.c"), folder / "run.c"]
    compiled([installed("gcc", package="gcc"), *SHARED, "-I", folder / "src", *sources, "-o", library])
    dtype = np.int32 if readings.dtype == np.int64 else np.float32
    samples = np.ascontiguousarray(readings.swapaxes(1, 2), dtype=dtype)
    verdict = np.empty(samples.shape[:2], dtype=np.int32)
    statistic = np.empty(samples.shape[:2], dtype=dtype)
    pointers = [ctypes.c_void_p(array.ctypes.data) for array in (samples, verdict, statistic)]
    cases, count = len(samples), samples.shape[1]
    ctypes.CDLL(str(library)).run(ctypes.c_long(cases), ctypes.c_long(count), *pointers)
    return TwinResult(verdict.astype(np.int64), statistic)


@pytest.mark.parametrize(("arithmetic", "n_channels"), BUILDS)
def test_c_is_bit_equal_to_its_twin(arithmetic: str, n_channels: int, tmp_path: Path) -> None:
    believed, numbers = exported(tmp_path, arithmetic, n_channels)
    sensor = SensorParameters((Channel.CURRENT, Channel.SPEED)[:n_channels], 0.02, 1.0)
    data = simulate(Scenario(PAPER_MOTOR, (Fault(FaultKind.BEARING, 0.25),), sensor=sensor), 1, range(40))
    measured = data.measurements.copy()
    measured[:8, 0, 400:700] = measured[:8, 0, 400, None]
    measured[4:12, -1, 800] = 1e3 * believed.limits.speed_rad_s
    measured[12:16, 0] = np.random.default_rng(1).normal(0.0, 0.02, measured[12:16, 0].shape)
    readings = readings_of(numbers, np.clip(measured, -2_000.0, 2_000.0), data.voltage_v)
    ours, theirs = run_twin(numbers, readings), run_c(tmp_path, readings)
    np.testing.assert_array_equal(theirs.verdict, ours.verdict)
    np.testing.assert_array_equal(theirs.statistic, ours.statistic)
    assert set(np.unique(ours.verdict)) >= {0, 1, 2, 3, 4}
    (sketch,) = tmp_path.rglob("*.ino")
    assert "#define M_RATE_HZ 10000\n" in (tmp_path / "src" / "m.h").read_text(encoding="utf-8")
    assert "due_us += 100UL;" in sketch.read_text(encoding="utf-8")


@pytest.mark.long
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize(("arithmetic", "n_channels"), BUILDS)
def test_compilers_and_sanitizers_find_nothing(
    compiler: str, arithmetic: str, n_channels: int, tmp_path: Path
) -> None:
    exported(tmp_path, arithmetic, n_channels)
    main = tmp_path / "hostile.c"
    main.write_text(RUN + HOSTILE.replace("EDGE_VALUES", EDGES[arithmetic]), encoding="utf-8")
    program, source = tmp_path / "hostile", tmp_path / "src" / "m.c"
    command: list[str | Path] = [
        installed(compiler, package=compiler),
        "-O1",
        *SANITIZERS,
        "-I",
        tmp_path / "src",
    ]
    compiled([*command, *WARNINGS, "-c", source, "-o", tmp_path / "m.o"])
    compiled([*command, "-Wno-div-by-zero", main, tmp_path / "m.o", "-o", program])
    done = subprocess.run([program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.long
def test_cmake_builds_and_tests_it(tmp_path: Path) -> None:
    exported(tmp_path, "fixed", 1)
    compiled([installed("cmake", package="cmake"), "-S", tmp_path, "-B", tmp_path / "build"])
    compiled(["cmake", "--build", tmp_path / "build"])
    compiled(["ctest", "--test-dir", tmp_path / "build"])
