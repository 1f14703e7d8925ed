"""Tables of results in README and docs are those that the kept results give."""

import leaderboard
import result_tables


def test_tables_of_readme_and_benchmark_page_come_from_their_files() -> None:
    """`python benchmarks/result_tables.py` writes them."""
    for path, text in result_tables.pages().items():
        assert path.read_text(encoding="utf-8") == text, path.name
        assert text.count("\n| ") > 8


def test_leaderboard_page_comes_from_its_scores() -> None:
    """`python benchmarks/leaderboard.py page` writes it."""
    assert leaderboard.PAGE.read_text(encoding="utf-8") == leaderboard.whole_page()
