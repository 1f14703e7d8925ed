"""The options that a refusal suggests."""

import re

_OPTION = re.compile(r'--column (?:"([^"]+)"|([^\s,;]+))')
_NUMBER = r"[-+]?[\d.]+"
_BLANKS = {"UNIT": r"\w+", "SCALE": _NUMBER, r"\+OFFSET": _NUMBER}


def options_of(sentence: str) -> list[str]:
    """What stands behind each `--column`, blanks in capitals among it; with the columns for COLUMN put in."""
    found = [quoted or plain for quoted, plain in _OPTION.findall(sentence)]
    several = re.search(r"where COLUMN is one of (.+?), and ", sentence)
    columns = several[1].split(", ") if several else []
    return [
        option.replace("COLUMN", column)
        for option in found
        for column in (columns if "COLUMN" in option else [""])
    ]


def has_blanks(option: str) -> bool:
    """Whether only the user can complete an option."""
    return any(blank in option for blank in ("UNIT", "SCALE", "COLUMN"))


def fits(option: str, named: str) -> bool:
    """Whether an option with its blanks filled is the one that was named."""
    pattern = re.escape(option)
    for blank, form in _BLANKS.items():
        pattern = pattern.replace(blank, form)
    return re.fullmatch(pattern, named) is not None
