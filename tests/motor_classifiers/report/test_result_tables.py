"""Tables of results in README and docs are those that the kept results give."""

import json

import leaderboard
import pytest
import result_tables

from motor_classifiers import load_task

# Reaches in: kept scores are of this version.
from motor_classifiers.scoring.frozen_tasks import VERSION


def test_tables_of_readme_and_docs_come_from_their_files() -> None:
    """`python benchmarks/result_tables.py` writes them."""
    for path, text in result_tables.pages().items():
        assert path.read_text(encoding="utf-8") == text, (
            f"`python benchmarks/result_tables.py` writes {path.name}"
        )
        assert text.count("\n| ") > 6


def test_sentence_of_the_readme_comes_from_the_leaderboard() -> None:
    behind = leaderboard.kept_scores()["bench/rules"]["above_limit"]
    text = result_tables.README.read_text(encoding="utf-8")
    assert f"On 5,000 other motors it is {behind:.2f} points behind" in text


@pytest.mark.parametrize("name", ["field", "operation"])
def test_brackets_of_the_tasks_are_those_that_were_measured(name: str) -> None:
    low, high = json.loads((result_tables.FOLDER / "results" / f"{name}_limit.json").read_bytes())["bracket"]
    assert load_task(name).bracket == pytest.approx((100.0 * (1.0 - high), 100.0 * (1.0 - low)), abs=0.006)


def test_leaderboard_page_comes_from_its_scores() -> None:
    """`python benchmarks/leaderboard.py page` writes it."""
    assert leaderboard.PAGE.read_text(encoding="utf-8") == leaderboard.whole_page()
    for name, row in leaderboard.kept_scores().items():
        assert (name, row["version"]) == (f"{row['task']}/{row['method']}", VERSION)


def test_no_kept_score_rises_above_its_limit() -> None:
    """By chance it may, by less than its interval; on average it cannot."""
    for name, row in leaderboard.kept_scores().items():
        if "limit" in row:
            assert row["above_limit_high"] > 0.0, name
        elif "bracket" in row:
            assert row["high"] > row["bracket"][0], name
