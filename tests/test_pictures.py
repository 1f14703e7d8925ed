"""Pictures of the documentation show what the code draws today; `make pictures` draws them anew."""

import json
import re
from importlib import import_module
from pathlib import Path

import film
import numpy as np
import residual_worth
import rules
import trust
from PIL import Image

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


def test_the_picture_of_the_fleet_is_that_of_today() -> None:
    drawn = import_module("make_pictures").fleet()
    assert (IMAGES / "fleet.svg").read_text(encoding="utf-8") == drawn


def test_the_picture_of_the_rooms_is_that_of_today(tmp_path: Path) -> None:
    import_module("make_pages").draw_rooms(tmp_path / "rooms.svg")
    assert (tmp_path / "rooms.svg").read_text(encoding="utf-8") == (IMAGES / "rooms.svg").read_text(
        encoding="utf-8"
    )


def test_the_delays_of_the_rules_are_those_of_today(tmp_path: Path) -> None:
    """The picture is drawn from kept delays, and the exact ones of them hold."""
    kept = json.loads(rules.KEPT_CURVES.read_bytes())
    rules.draw(kept, tmp_path / "rules.svg")
    assert (tmp_path / "rules.svg").read_text(encoding="utf-8") == rules.PICTURE.read_text(encoding="utf-8")
    for name, rule in {rules.LEAST: Cusum(rules.DRAWN), "3 of 5": MOfN(3, 5)}.items():
        threshold = rule.threshold_for(arl0=rules.DRAWN_AT[1]).value
        assert abs(rule.average_run_length(threshold, rules.DRAWN) - kept[name][1]) < 0.01


def test_the_charts_of_the_trust_page_are_those_of_the_kept_figures() -> None:
    """`python benchmarks/trust.py charts` writes them."""
    charts = dict(trust.kept_charts())
    assert len(charts) == 2
    assert {name: (IMAGES / name).read_text(encoding="utf-8") for name in charts} == charts


def test_the_learning_curves_are_those_of_the_kept_trainings(tmp_path: Path) -> None:
    residual_worth.draw(tmp_path / "curves.svg")
    drawn = (tmp_path / "curves.svg").read_text(encoding="utf-8")
    assert drawn == residual_worth.PICTURE.read_text(encoding="utf-8")


def test_the_pages_of_the_environments_are_those_of_today(tmp_path: Path) -> None:
    """`make pages` writes them anew: specification, options, scores, screens, learning curves."""
    import_module("environment_pages").write_pages(tmp_path)
    pages = ROOT / "docs" / "environments"
    assert {path.name for path in pages.iterdir()} == {path.name for path in tmp_path.iterdir()}
    for drawn in tmp_path.glob("*.md"):
        assert (pages / drawn.name).read_text(encoding="utf-8") == drawn.read_text(encoding="utf-8"), (
            "make pages"
        )
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
