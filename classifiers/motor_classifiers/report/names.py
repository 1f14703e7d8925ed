"""Class names for people."""

from motor_env.motor.faults import HEALTHY


def readable(name: str) -> str:
    """A class name in words: bearing_10 becomes bearing 10 %."""
    stem, _, level = name.rpartition("_")
    return (
        f"{stem.replace('_', ' ')} {level} %" if level.replace(".", "").isdigit() else name.replace("_", " ")
    )


def short(name: str) -> str:
    """A class name for narrow columns: B 10, WC 25."""
    stem, _, level = name.rpartition("_")
    if not level.replace(".", "").isdigit():
        return "ok" if name == HEALTHY else name[:3]
    return f"{''.join(word[0].upper() for word in stem.split('_'))} {level}"
