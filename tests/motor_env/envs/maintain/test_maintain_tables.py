"""The maintenance tasks are worth what their kept results say."""

import pytest
from maintain import TASKS
from tables import kept_tables


@pytest.mark.parametrize("name", TASKS)
def test_the_plan_is_close_to_its_bound(name: str) -> None:
    shown = {policy: mean.split(" ± ") for policy, mean, _ in kept_tables("decisions")[name]["rows"]}
    found = {policy: float(mean) for policy, (mean, *_) in shown.items()}
    width = found["bound"] - found["plan"] + float(shown["plan"][1])
    assert 0.0 < width < 0.02 * (found["sees the wear"] - found["run to failure"])
