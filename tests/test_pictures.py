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
import residual_worth
import result_tables
import rules
import trust
from PIL import Image

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"


def far_off(kept: Image.Image, drawn: Image.Image) -> float:
    """Share of the pixels that differ by more than the reduction to a few colours does."""
    assert kept.size == drawn.size
    apart = np.abs(np.asarray(kept.convert("RGB"), float) - np.asarray(drawn.convert("RGB"), float))
    return float((apart.max(axis=-1) > 60.0).mean())


def test_the_picture_of_the_readme_and_both_ends_of_the_film_are_those_of_today(tmp_path: Path) -> None:
    import_module("make_hero").main(tmp_path / "hero.png")
    with Image.open(IMAGES / "hero.png") as kept, Image.open(tmp_path / "hero.png") as drawn:
        assert far_off(kept, drawn) < 0.001
    with Image.open(film.FILM) as kept:
        for frame in (0, kept.n_frames - 1):
            kept.seek(frame)
            assert far_off(kept, Image.fromarray(film.last_screen())) < 0.001


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


def test_the_delays_of_the_rules_are_drawn_from_the_kept_ones(tmp_path: Path) -> None:
    kept = json.loads(rules.KEPT_CURVES.read_bytes())
    rules.draw(kept, tmp_path / "rules.svg")
    assert (tmp_path / "rules.svg").read_text(encoding="utf-8") == rules.PICTURE.read_text(encoding="utf-8")


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


def test_every_picture_is_shown() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    shown = "".join(page.read_text(encoding="utf-8") for page in pages)
    kept = {path.name for path in IMAGES.iterdir() if path.suffix in (".svg", ".png", ".gif")}
    assert {name for name in kept if f"images/{name}" not in shown} == set()


def test_tables_come_from_their_files() -> None:
    for path, text in (result_tables.pages() | {leaderboard.PAGE: leaderboard.whole_page()}).items():
        assert path.read_text(encoding="utf-8") == text, f"`python benchmarks/result_tables.py`: {path.name}"
    behind = leaderboard.kept_scores()["bench/rules"]["above_limit"]
    assert f"On 5,000 other motors it is {behind:.2f} points behind" in result_tables.README.read_text(
        "utf-8"
    )
