"""The maintenance tasks are worth what their kept results say."""

import json

import maintain


def test_the_plan_is_close_to_its_bound() -> None:
    for rows in json.loads(maintain.RESULTS.read_text(encoding="utf-8")).values():
        found = {row["policy"]: row["return"] for row in rows}
        half = next(row["half_width"] for row in rows if row["policy"] == "plan")
        width = found["bound"] - found["plan"] + half
        assert 0.0 < width < 0.02 * (found["sees the wear"] - found["run to failure"])
