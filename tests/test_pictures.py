"""Pictures and tables of the documentation are those of the code and of the kept results.

`make pictures`, `python benchmarks/result_tables.py` and `python benchmarks/leaderboard.py page` make them anew.
"""

import json
import re
from importlib import import_module
from pathlib import Path

import film
import leaderboard
import numpy as np
import pytest
import residual_worth
import result_tables
import rules
import trust
from PIL import Image

from motor_classifiers import load_task
from motor_env import Cusum, MOfN

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"


def far_off(kept: Image.Image, drawn: Image.Image) -> float:
    """Share of the pixels that differ by more than the reduction to a few colours does."""
    assert kept.size == drawn.size
    apart = np.abs(np.asarray(kept.convert("RGB"), float) - np.asarray(drawn.convert("RGB"), float))
    return float((apart.max(axis=-1) > 60.0).mean())


def test_the_film_ends_with_the_screen_of_today_and_begins_with_it() -> None:
    today = Image.fromarray(film.last_screen())
    with Image.open(film.FILM) as kept:
        assert far_off(kept, today) < 0.001
        kept.seek(kept.n_frames - 1)
        assert far_off(kept, today) < 0.001


def test_the_verdict_of_the_first_page_is_that_of_today() -> None:
    """Same shapes and words; numbers may round otherwise on another processor."""
    number = re.compile(r"-?\d+\.\d+")
    kept = (IMAGES / "verdict.svg").read_text(encoding="utf-8")
    drawn = import_module("make_pictures").verdict()
    assert number.sub("#", kept) == number.sub("#", drawn)
    was, now = (np.array(number.findall(text), float) for text in (kept, drawn))
    np.testing.assert_allclose(now, was, atol=0.3)


def test_drawings_are_those_of_today_or_of_the_kept_results(tmp_path: Path) -> None:
    import_module("make_pages").draw_rooms(tmp_path / "rooms.svg")
    residual_worth.draw(tmp_path / "residual-worth.svg")
    drawn = {path.name: path.read_text(encoding="utf-8") for path in tmp_path.iterdir()}
    drawn |= {"fleet.svg": import_module("make_pictures").fleet()} | dict(trust.kept_charts())
    assert len(drawn) == 5
    assert {name: (IMAGES / name).read_text(encoding="utf-8") for name in drawn} == drawn


def test_the_delays_of_the_rules_are_those_of_today(tmp_path: Path) -> None:
    """The picture is drawn from kept delays, and the exact ones of them hold."""
    kept = json.loads(rules.KEPT_CURVES.read_bytes())
    rules.draw(kept, tmp_path / "rules.svg")
    assert (tmp_path / "rules.svg").read_text(encoding="utf-8") == rules.PICTURE.read_text(encoding="utf-8")
    for name, rule in {rules.LEAST: Cusum(rules.DRAWN), "3 of 5": MOfN(3, 5)}.items():
        threshold = rule.threshold_for(arl0=rules.DRAWN_AT[1]).value
        assert abs(rule.average_run_length(threshold, rules.DRAWN) - kept[name][1]) < 0.01


def test_the_pages_of_the_environments_are_those_of_today(tmp_path: Path) -> None:
    """`make pages` writes them anew."""
    import_module("environment_pages").write_pages(tmp_path)
    pages = ROOT / "docs" / "environments"
    assert {path.name for path in pages.iterdir()} == {path.name for path in tmp_path.iterdir()}
    for drawn in tmp_path.glob("*.md"):
        assert (pages / drawn.name).read_text("utf-8") == drawn.read_text("utf-8"), "make pages"
    for path in tmp_path.glob("*.png"):
        with Image.open(pages / path.name) as kept, Image.open(path) as drawn:
            assert far_off(kept, drawn) < 0.001, f"make pages: {path.name}"


def test_every_picture_is_shown_and_has_a_test() -> None:
    """Those of the paper are held by the golden results of tests/motor_env."""
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    shown = "".join(page.read_text(encoding="utf-8") for page in pages)
    kept = {path.name for path in IMAGES.iterdir() if path.suffix in (".svg", ".png", ".gif")}
    assert {name for name in kept if f"images/{name}" not in shown} == set()
    of_the_paper = {name for name in kept if name.startswith(("figure_", "error_covariance"))}
    assert kept - of_the_paper == {
        *("hero.png", "rooms.svg", "verdict.svg", "probe-agent.gif", "fleet.svg", "q-and-r.png"),
        *("rules_delay.svg", "other-roc.svg", "early-verdicts.svg", "residual-worth.svg"),
    }


def test_the_picture_of_the_readme_is_that_of_today(tmp_path: Path) -> None:
    import_module("make_hero").main(tmp_path / "hero.png")
    with Image.open(IMAGES / "hero.png") as kept, Image.open(tmp_path / "hero.png") as drawn:
        assert far_off(kept, drawn) < 0.001


def test_tables_come_from_their_files() -> None:
    for path, text in (result_tables.pages() | {leaderboard.PAGE: leaderboard.whole_page()}).items():
        assert path.read_text(encoding="utf-8") == text, f"`python benchmarks/result_tables.py`: {path.name}"
    behind = leaderboard.kept_scores()["bench/rules"]["above_limit"]
    assert f"On 5,000 other motors it is {behind:.2f} points behind" in result_tables.README.read_text(
        "utf-8"
    )


@pytest.mark.parametrize("name", ["field", "operation"])
def test_brackets_of_the_tasks_are_those_that_were_measured(name: str) -> None:
    low, high = json.loads((result_tables.FOLDER / "results" / f"{name}_limit.json").read_bytes())["bracket"]
    assert load_task(name).bracket == pytest.approx((100.0 * (1.0 - high), 100.0 * (1.0 - low)), abs=0.006)


def test_no_kept_score_rises_above_its_limit() -> None:
    """By chance it may, by less than its interval; on average it cannot."""
    for name, row in leaderboard.kept_scores().items():
        assert row.get("above_limit_high", 1.0) > 0.0, name
        assert row["high"] > row.get("bracket", [0.0])[0], name
