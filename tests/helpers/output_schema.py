"""Whether what a command prints with --json follows docs/output.schema.json, and is JSON without NaN."""

import json
from pathlib import Path
from typing import Any

import jsonschema

DEFINITIONS = json.loads(
    (Path(__file__).parents[2] / "docs" / "output.schema.json").read_text(encoding="utf-8")
)["$defs"]


def no_number(word: str) -> None:
    raise ValueError(f"{word} is not JSON")


def follows(command: str, text: str) -> Any:
    """What was printed, if it follows the definition of the command."""
    value = json.loads(text, parse_constant=no_number)
    schema = {"$ref": f"#/$defs/{command.replace(' ', '%20')}", "$defs": DEFINITIONS}
    jsonschema.Draft202012Validator(schema).validate(value)
    return value
