"""What was handed in to the lab to compare with: one's own motor file and healthy starts, for as long as it runs."""

from __future__ import annotations

import tempfile
from pathlib import Path

from motor_env.errors import InputError
from motor_env.motor.data_sheet import load_motor
from motor_env.motor.parameters import CATALOGUE
from motor_env.recordings.recording import read_recording

LARGEST_UPLOAD_BYTES = 20_000_000
_MOST_STARTS = 20
OWN_MOTOR, HEALTHY_STARTS = "own motor", "healthy starts"


class Shelf:
    """Files in a temporary folder; what cannot be read is not kept."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="motor-env-lab-")
        self.motor: Path | None = None
        self.healthy: list[Path] = []

    def clear(self) -> None:
        """Delete all of it."""
        self._folder.cleanup()

    def keep(self, kind: str, name: str, content: bytes) -> dict[str, str | int]:
        """Take in a motor file or one healthy start; the answer says what is there to compare with.

        Raises:
            InputError: too many, or not readable; the sentence speaks of the page's name.
        """
        shown = shown_name(name)
        if kind not in ("motor", "healthy"):
            raise InputError(f"kind must be motor or healthy, got {kind[:40]!r}")
        if len(self.healthy) >= _MOST_STARTS:
            raise InputError(f"at most {_MOST_STARTS} healthy starts can be compared with")
        ending = ".toml" if kind == "motor" else ending_of(shown)
        path = Path(self._folder.name) / f"{kind}-{len(self.healthy)}{ending}"
        path.write_bytes(content)
        try:
            if kind == "motor":
                load_motor(path)
                self.motor = path
            else:
                read_recording(path)
                self.healthy.append(path)
        except InputError as error:
            raise InputError(str(error).replace(str(path), shown)) from None
        return {
            "name": shown,
            "reference": OWN_MOTOR if kind == "motor" else HEALTHY_STARTS,
            "healthy": len(self.healthy),
        }

    def reference(self, wanted: str) -> tuple[str | None, list[Path]]:
        """Motor and healthy starts to compare with, for what the page has chosen.

        Raises:
            InputError: nothing of the kind was handed in, or there is no such motor.
        """
        if wanted == HEALTHY_STARTS and self.healthy:
            return None, self.healthy
        if wanted == OWN_MOTOR and self.motor is not None:
            return str(self.motor), []
        if wanted in (OWN_MOTOR, HEALTHY_STARTS):
            raise InputError(f"no {wanted} handed in yet")
        if wanted not in ("", *CATALOGUE):
            raise InputError(f"motor must be one of {', '.join(CATALOGUE)}, got {wanted[:40]!r}")
        return wanted or None, []


def shown_name(name: str) -> str:
    """A file's name as the page shows it."""
    return "".join(character for character in name if character.isprintable())[:80] or "recording"


def ending_of(shown: str) -> str:
    """The ending by which its format is told."""
    suffix = Path(shown).suffix.lower()
    return suffix if suffix[1:].isalnum() and len(suffix) <= 9 else ".csv"
