"""Size and instructions a sample of `motor-env export-c` on two chips: cross-compiled with GCC, counted in QEMU.

    python benchmarks/controllers.py && python benchmarks/result_tables.py

Needs arm-none-eabi-gcc (with newlib) and qemu-system-arm: the Debian packages gcc-arm-none-eabi,
libnewlib-arm-none-eabi, qemu-system-arm.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import NamedTuple

from tables import keep_table

from motor_env import PAPER_MOTOR, Motor, Scenario, SensorParameters, simulate
from motor_env.diagnosis.embedded.monitor import CusumBank, Monitor, monitor_of
from motor_env.diagnosis.embedded.source import literal, write_library
from motor_env.diagnosis.embedded.twin import Numbers, fixed_point, floating, readings_of, run_twin
from motor_env.motor.parameters import Channel

SAMPLES = 250
HEADER = (
    "chip",
    "arithmetic",
    "channels",
    "flash",
    "with self test",
    "RAM",
    "instructions a sample",
)


class Chip(NamedTuple):
    """A processor, GCC's options for it, and a board of QEMU's that has it."""

    name: str
    options: tuple[str, ...]
    board: str


CHIPS = (
    Chip("Cortex-M0+", ("-mcpu=cortex-m0plus", "-mfloat-abi=soft"), "microbit"),
    Chip("Cortex-M4F", ("-mcpu=cortex-m4", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"), "mps2-an386"),
)

LINK = """MEMORY { FLASH (rx) : ORIGIN = 0, LENGTH = 128K  RAM (rw) : ORIGIN = 0x20000000, LENGTH = 16K }
SECTIONS {
  .text : { KEEP(*(.vectors)) *(.text*) *(.rodata*) } > FLASH
  .ARM.exidx : { *(.ARM.exidx*) } > FLASH
  .bss (NOLOAD) : { *(.data*) *(.bss*) *(COMMON) } > RAM
}
"""
START = """
extern int main(void);
static void leave(int is_wrong)
{
    register unsigned call __asm__("r0") = 0x18, reason __asm__("r1") = is_wrong ? 0x20023u : 0x20026u;
    __asm__ volatile("bkpt 0xab" : : "r"(call), "r"(reason));
}
void reset(void)
{
    *(volatile unsigned *)0xE000ED88 = 0xF00000; /* the floating-point unit, where there is one */
    leave(main());
    for (;;) {}
}
__attribute__((section(".vectors"), used)) void *const vectors[] = {(void *)0x20004000, (void *)reset};
"""


class Measured(NamedTuple):
    """One build on one chip, in bytes and in instructions a sample."""

    chip: str
    arithmetic: str
    n_channels: int
    flash: int
    flash_with_self_test: int
    ram: int
    instructions: float


def tool(name: str) -> str:
    """Path of a program.

    Raises:
        RuntimeError: it is not installed.
    """
    path = shutil.which(name)
    if path is None:
        raise RuntimeError(f"{name} is not installed")
    return path


def paper_monitor(*, n_channels: int = 1) -> Monitor:
    """The textbook motor at 1 kHz."""
    channels = (Channel.CURRENT, Channel.SPEED)[:n_channels]
    return monitor_of(
        Motor("paper", "data_sheet", PAPER_MOTOR),
        1000.0,
        rule=CusumBank(),
        sensor=SensorParameters(channels, 0.02, 1.0),
        voltage_v=12.0,
    )


def program(numbers: Numbers, monitor: Monitor, count: int) -> str:
    """A main that steps through a simulated start and compares the last statistic with the twin's, bit by bit."""
    channels = (Channel.CURRENT, Channel.SPEED)[: len(monitor.kalman.observation)]
    scenario = Scenario(PAPER_MOTOR, sensor=SensorParameters(channels, 0.02, 1.0))
    start = simulate(scenario, 1, [0])
    readings = readings_of(numbers, start.measurements, start.voltage_v)[..., :SAMPLES]
    rows = ",".join("{" + ",".join(literal(value) for value in row) + "}" for row in readings[0].T)
    last = literal(run_twin(numbers, readings[..., :count]).statistic[0, -1])
    return f"""#include "m.h"
static const m_sample SAMPLES[{SAMPLES}] = {{{rows}}};
static m monitor;
int main(void)
{{
    int k;
    m_init(&monitor);
    for (k = 0; k < {count}; ++k) {{ m_step(&monitor, SAMPLES[k]); }}
    return monitor.statistic != {last};
}}
"""


BARE = """#include "m.h"
static m monitor;
int main(void)
{
    m_init(&monitor);
    return (int)m_step(&monitor, *(volatile m_sample *)0x20003000) CHECK;
}
"""


def build(chip: Chip, folder: Path, main: str, *options: str) -> Path:
    """Link a main with the library in `folder`.

    Raises:
        RuntimeError: the compiler refuses it.
    """
    (folder / "main.c").write_text(f"{START}{main}", encoding="utf-8")
    script, elf = folder / "link.ld", folder / "monitor.elf"
    script.write_text(LINK, encoding="utf-8")
    flags = ["-std=gnu99", "-Os", "-mthumb", "-ffp-contract=off", "-ffunction-sections", "-fdata-sections"]
    sources: list[str | Path] = ["-I", folder / "src", folder / "main.c", folder / "src" / "m.c"]
    link: list[str | Path] = ["-nostartfiles", "--specs=nano.specs", "-Wl,--gc-sections"]
    done = subprocess.run(
        [
            tool("arm-none-eabi-gcc"),
            *chip.options,
            *flags,
            *options,
            *sources,
            *link,
            "-T",
            script,
            "-o",
            elf,
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(done.stderr)
    return elf


def sizes(elf: Path) -> tuple[int, int]:
    """Bytes of flash, everything linked, and bytes of variables."""
    out = subprocess.run([tool("arm-none-eabi-size"), elf], capture_output=True, text=True, check=True).stdout
    text, data, bss = (int(word) for word in out.splitlines()[1].split()[:3])
    return text + data, data + bss


def instructions(chip: Chip, elf: Path) -> int:
    """Instructions of a whole run.

    Raises:
        RuntimeError: the last statistic is not the twin's.
    """
    log = elf.with_suffix(".log")
    board: list[str | Path] = ["-M", chip.board, "-kernel", elf, "-nographic", "-semihosting"]
    done = subprocess.run(
        [tool("qemu-system-arm"), *board, "-singlestep", "-d", "exec,nochain", "-D", log],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"{chip.name}: the statistic is not the twin's, or QEMU failed: {done.stderr}")
    return len(re.findall(r"^Trace ", log.read_text(encoding="utf-8"), re.MULTILINE))


def measure(chip: Chip, arithmetic: str, *, n_channels: int = 1) -> Measured:
    """Sizes and instructions of one build."""
    monitor = paper_monitor(n_channels=n_channels)
    steps = monitor.limits.counts() if arithmetic == "fixed" else None
    numbers = floating(monitor) if steps is None else fixed_point(monitor, steps)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_library(monitor, folder, steps=steps, name="m", wanted="1 false alarm a year")
        flash, ram = sizes(build(chip, folder, BARE, "-DCHECK="))
        tested, _ = sizes(build(chip, folder, BARE, "-DCHECK=+m_self_test()"))
        counts = [
            instructions(chip, build(chip, folder, program(numbers, monitor, n)))
            for n in (SAMPLES // 5, SAMPLES)
        ]
    a_sample = (counts[1] - counts[0]) / (SAMPLES - SAMPLES // 5)
    return Measured(chip.name, arithmetic, n_channels, flash, tested, ram, a_sample)


def main() -> None:
    """Measure the sizes and keep the table of docs/results/exported-c.md."""
    found = (
        measure(chip, arithmetic, n_channels=n_channels)
        for chip in CHIPS
        for arithmetic in ("fixed", "float")
        for n_channels in (1, 2)
    )
    rows = ([*map(str, sizes), f"{instructions:.0f}"] for *sizes, instructions in found)
    keep_table("exported-c", "sizes", HEADER, rows)


if __name__ == "__main__":
    main()
