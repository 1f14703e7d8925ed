"""The maintenance tasks are worth what their kept results say."""

import json

import maintain

import motor_env


def test_thresholds_and_brackets_are_those_of_the_results() -> None:
    import gymnasium as gym

    for name, rows in json.loads(maintain.RESULTS.read_text(encoding="utf-8")).items():
        found = {row["policy"]: row["return"] for row in rows}
        assert gym.spec(f"{motor_env.__name__}/{name}").reward_threshold == round(found["plan"], 3)
        half = next(row["half_width"] for row in rows if row["policy"] == "plan")
        width = found["bound"] - found["plan"] + half
        assert 0.0 < width < 0.02 * (found["sees the wear"] - found["run to failure"])
