"""Tables of docs/howto/watch.md and docs/results/embedded.md from watch.json, watch_c.json and controllers.json."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from statistics import median
from typing import Any

from tables import table
from watch_counts import NO_ALARM, RATES, alarm_row

RESULTS = Path(__file__).resolve().parent / "results"
TEMPERATURES = {
    "steady": "test bench, `--steady`",
    "allowed": "temperature wanders after the commissioning",
    "wandering": "temperature wanders from the begin",
}
_ALARMS = ("window", "early", "another_motor")


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
            counts: Counter[str] = sum((Counter(run["events"][rate]) for run in runs), Counter())
            alarms = sum(n for name, n in counts.items() if name.startswith(_ALARMS) and name not in NO_ALARM)
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
            f"{row['fault']} +{row['severity']:.0%}",
            f"{row['best_s']:.3g}",
            f"{row['watch_s']:.3g}",
            f"{row['watch_s'] / row['best_s']:.1f}",
            f"{row['named']:.0%}",
        ]
        for row in _read("watch_delays.json")
    ]
    return table(["fault", "the best CUSUM (s)", "`watch` (s)", "ratio", "called by its name at once"], rows)


def windows() -> str:
    """Windows that `watch` needs for a fault, and what it calls it."""
    runs, rows = [run for run in _read("watch.json") if run["faults"]], []
    for group in zip(*(run["faults"] for run in runs), strict=True):
        needed = [count for row in group for count in row["windows"]]
        named: Counter[str] = sum((Counter(row["named"]) for row in group), Counter())
        words = ", ".join(f"{n} `{name}`" for name, n in named.most_common())
        fault = f"{group[0]['fault']} +{group[0]['severity']:.0%}"
        rows.append([fault, f"{median(needed):g}", str(max(needed)), words])
    return table(["fault", "windows to the first alarm (median)", "largest", "called"], rows)


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
        "howto/watch": {"false alarms": watch_alarms(), "delays": watch_delays(), "windows": windows()},
        "results/embedded": {"false alarms": code_alarms(), "delays": delays(), "sizes": sizes()},
    }
