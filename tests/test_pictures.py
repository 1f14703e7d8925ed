"""Pictures of the documentation show what the code draws today; `make pictures` draws them anew."""

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import film
import numpy as np
from PIL import Image

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"


def module(path: Path) -> ModuleType:
    """A script of the documentation."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


def far_off(kept: Image.Image, drawn: Image.Image) -> float:
    """Share of the pixels that differ by more than the reduction to a few colours does."""
    assert kept.size == drawn.size
    apart = np.abs(np.asarray(kept.convert("RGB"), float) - np.asarray(drawn.convert("RGB"), float))
    return float((apart.max(axis=-1) > 60.0).mean())


def test_the_film_ends_with_the_screen_of_today_and_begins_with_it() -> None:
    today = Image.fromarray(film.last_screen(film.FILM))
    with Image.open(film.FILM) as kept:
        assert far_off(kept, today) < 0.001
        kept.seek(kept.n_frames - 1)
        assert far_off(kept, today) < 0.001


def test_the_verdict_of_the_first_page_is_that_of_today() -> None:
    """Same shapes and words; numbers may round otherwise on another processor."""
    number = re.compile(r"-?\d+\.\d+")
    kept = (IMAGES / "verdict.svg").read_text(encoding="utf-8")
    drawn = module(ROOT / "docs" / "make_pictures.py").verdict()
    assert number.sub("#", kept) == number.sub("#", drawn)
    was, now = (np.array(number.findall(text), float) for text in (kept, drawn))
    np.testing.assert_allclose(now, was, atol=0.3)


def test_the_picture_of_the_rooms_is_that_of_today(tmp_path: Path) -> None:
    module(ROOT / "docs" / "make_pages.py").draw_rooms(tmp_path / "rooms.svg")
    assert (tmp_path / "rooms.svg").read_text(encoding="utf-8") == (IMAGES / "rooms.svg").read_text(
        encoding="utf-8"
    )


def test_the_picture_of_the_readme_is_that_of_today(tmp_path: Path) -> None:
    module(IMAGES / "make_hero.py").main(tmp_path / "hero.png")
    with Image.open(IMAGES / "hero.png") as kept, Image.open(tmp_path / "hero.png") as drawn:
        assert far_off(kept, drawn) < 0.001
