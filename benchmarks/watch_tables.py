"""Tables of watch.md in docs/howto and docs/results, and of docs/results/embedded.md, from the kept results."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tables import table
from watch_counts import RATES, alarm_row

from motor_env.diagnosis.running.counting import fewest_in_a_row
from motor_env.diagnosis.running.scales import AXES
from motor_env.diagnosis.running.vigil import YEAR_S

COUNTED_S = 20.0  # windows of the table of promises
RESULTS = Path(__file__).resolve().parent / "results"
TEMPERATURES = {
    "steady": "test bench, `--steady`",
    "allowed": "temperature wanders after the commissioning",
    "wandering": "temperature wanders from the begin",
}


def _read(name: str) -> Any:
    return json.loads((RESULTS / name).read_bytes())


def _alarms(rows: list[list[str]]) -> str:
    return table(["monitor", "asked for", "hours", "alarms due", "1 to 99 % of Poisson's", "alarms"], rows)


def watch_alarms() -> str:
    """False alarms of `watch` beside the number that was asked for."""
    rows = []
    for temperature, said in TEMPERATURES.items():
        runs = [run for run in _read("watch.json") if run["temperature"] == temperature]
        hours = sum(run["hours"] for run in runs)
        for rate in RATES if runs else ():
            alarms = sum(run["alarms"][rate] for run in runs)
            rows.append(alarm_row(f"`watch`; {said}", rate, hours, alarms))
    return _alarms(rows)


def code_alarms() -> str:
    """False alarms of the C code."""
    code = _read("watch_c.json")
    names = {name: name.split(", one a ") for name in code["alarms"]}
    return _alarms(
        [
            alarm_row(f"C, {arithmetic}; known motor, no load", rate, code["hours"], code["alarms"][name])
            for name, (arithmetic, rate) in names.items()
        ]
    )


def delays() -> str:
    """Delays of the C code beside those of the CUSUM that knows the fault."""
    code, rows = _read("watch_c.json"), []
    for duty in ("one direction", "both directions"):
        for row in code[f"delays_{duty.replace(' ', '_')}"]:
            best_s, ours_s = row["best_s"], row["delay_s"]
            shown = ["never" if s is None else f"{s:.3g}" for s in (best_s, *ours_s.values())]
            ratio = f"{ours_s['bank'] / best_s:.1f}"
            rows.append([duty, f"{row['fault']} +{row['severity']:.0%}", *shown, ratio])
    rules = [name if name == "bank" else f"`{name}`" for name in code["delays_one_direction"][0]["delay_s"]]
    return table(["duty cycle", "fault", "the best CUSUM", *rules, "bank over best"], rows)


def watch_delays() -> str:
    """Delays of `watch` beside those of the CUSUM that knows the fault."""
    rows = [
        [
            f"{row['fault']} +{row['severity']:.1%}",
            f"{row['best_s']:.3g}",
            *("never" if row[name] is None else f"{row[name]:.4g}" for name in ("hour_s", "year_s")),
            "-" if row["hour_s"] is None else f"{row['hour_s'] / row['best_s']:.1f}",
            f"{row['named']:.0%}",
            f"{row['named_next']:.0%}",
        ]
        for row in sorted(_read("watch_delays.json"), key=lambda row: (row["fault"], row["severity"]))
    ]
    header = ["fault", "best CUSUM, hour (s)", "`watch`, hour (s)", "year (s)", "ratio, hour"]
    return table([*header, "named at once", "by the next alarm"], rows)


def promises() -> str:
    """Windows in a row that counting needs, by the number of healthy windows and the rate that is asked for."""
    rates = {"an hour": 3600.0, "a day": 86_400.0, "a month": YEAR_S / 12.0, "a year": YEAR_S}
    rows = [
        [str(n), *(str(fewest_in_a_row(n, every_s / COUNTED_S, len(AXES))) for every_s in rates.values())]
        for n in (4, 10, 20, 30, 100)
    ]
    return table(["healthy windows", *(f"one {name}" for name in rates)], rows)


def sizes() -> str:
    """Bytes and instructions of the C code."""
    rows = _read("controllers.json")
    names = {"n_channels": "channels", "flash_with_self_test": "with self test", "ram": "RAM"}
    header = [names.get(name, name) for name in rows[0]]
    header[-1] = "instructions a sample"
    return table(
        header, [[f"{v:.0f}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows]
    )


def parts() -> dict[str, dict[str, str]]:
    """Tables by page and mark."""
    return {
        "howto/watch": {"promises": promises()},
        "results/watch": {"false alarms": watch_alarms(), "delays": watch_delays()},
        "results/embedded": {"false alarms": code_alarms(), "delays": delays(), "sizes": sizes()},
    }
