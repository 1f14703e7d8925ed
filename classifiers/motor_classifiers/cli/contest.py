"""The commands `task`, `submit`, `score` and `score-recordings` of motor-bench."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from motor_env import console
from motor_env.errors import InputError, require_extra
from motor_env.files import LARGEST_NOTE_BYTES, read_file


def _seed(sealed: Path | None) -> int | None:
    """The one number of a file; None for the public split."""
    if sealed is None:
        return None
    content = read_file(sealed, LARGEST_NOTE_BYTES)
    try:
        seed = int(content)
    except ValueError:
        seed = -1
    if not 2**48 <= seed < 2**64:  # smaller ones are soon tried
        raise InputError(f"{sealed}: must hold one whole number from 2^48 to 2^64 - 1")
    return seed


def task(name: str, /, *, out: Path, sealed: Path | None = None) -> int:
    """Write a task of motor-bench: what it asks, labelled starts to learn from, and test cases without labels.

    Example: motor-classifiers task bench --out out/bench-task

    Args:
        name: bench, bench-full, field, operation, reference, severity, unknown or stream.
        out: Folder of task.json, train.npz and test.npz.
        sealed: File with the secret seed of a sealed test split; for maintainers.
    """
    require_extra("sklearn", "classifiers")
    import numpy as np

    from motor_classifiers.contest.tasks import load_task
    from motor_env.files import replacing, write_text

    chosen = replace(load_task(name), sealed=_seed(sealed))
    train, test = chosen.learned(), chosen.test()
    arrays: dict[str, dict[str, Any]] = {"train": train, "test": {"X": test.X}}
    for part, content in arrays.items():
        with replacing(out / f"{part}.npz") as temporary:
            np.savez(temporary, allow_pickle=False, **content)
    write_text(out / "task.json", json.dumps(chosen.as_json(), indent=1) + "\n")
    print(f"{chosen.title}: {chosen.n_train} starts to learn from, {len(test.X)} cases to answer: {out}")
    return 0


def submit(
    task: str,
    /,
    *,
    method: str,
    out: Path,
    authors: str,
    about: str | None = None,
    link: str = "",
    seed: console.Whole = 0,
    sealed: Path | None = None,
) -> int:
    """Train a method on a task's starts and write its answers as a submission.

    Example: motor-classifiers submit bench --method residual-qda --authors "Jane Doe" --out out/my-submission

    Args:
        task: A task whose answers are probabilities: bench, bench-full, field, operation or reference.
        method: A method of the benchmark, an entry point, or FILE.py:NAME, your own.
        out: Folder of card.toml and answers.parquet.
        authors: Who made the method.
        about: What it is; the method's own words by default.
        link: Where its code is.
        seed: Random state of the training.
        sealed: File with the secret seed of a sealed test split; for maintainers.
    """
    require_extra("sklearn", "classifiers")
    from rich.console import Console

    from motor_classifiers.contest.submissions import write_submission
    from motor_classifiers.contest.tasks import load_task
    from motor_classifiers.estimators.own_methods import find_method
    from motor_classifiers.scoring.judging import judge
    from motor_classifiers.scoring.task import ClassTask

    asked, chosen = replace(load_task(task), sealed=_seed(sealed)), find_method(method)
    if not isinstance(asked, ClassTask):
        raise InputError(f"task {task} asks for no probabilities; write its answers with write_submission")
    with Console(stderr=True).status(f"training {method}"):
        answers = judge(method, asked, seed).probabilities
    name = method.rpartition(":")[2]
    seen = "fresh starts of the recipe" if chosen.from_stream else f"{asked.n_train:,} starts"
    card = {
        "method": name,
        "authors": authors,
        "about": about or chosen.title,
        "learned_from": seen,
        "link": link,
    }
    write_submission(out, asked, answers, card)
    print(f"{name} on task {task}: {len(answers)} cases answered: {out}")
    return 0


def score(
    submission: Path, /, *, sealed: Path | None = None, keep: Path | None = None, json_: bool = False
) -> int:
    """Check a submission and score it, beside the best possible on the same cases. Nothing in it is run.

    Example: motor-classifiers score out/my-submission

    Args:
        submission: Folder with card.toml and answers.parquet.
        sealed: File with the secret seed of the split that it answers; the public split by default.
        keep: Folder in which the score stays as TASK/METHOD.json, for the leaderboard.
        json_: Print the score as JSON.
    """
    require_extra("sklearn", "classifiers")
    from motor_classifiers.contest.leaderboard import file_of
    from motor_classifiers.contest.submissions import score_submission
    from motor_env.files import write_text

    scored = score_submission(submission, sealed=_seed(sealed))
    if sealed is not None:
        scored.pop("costs", None)  # beside one's own answers they tell the truth
    text = json.dumps(scored, indent=1) + "\n"
    if keep is not None:
        write_text(file_of(keep, scored), text)
    if json_:
        print(text, end="")
        return 0
    print(f"{scored['method']} on {scored['task']} {scored['version']}, {scored['n_test']} cases")
    print(f"  {scored['metric']}: {scored['value']:.2f} ({scored['low']:.2f} to {scored['high']:.2f})")
    if "limit" in scored:
        low, high = scored["above_limit_low"], scored["above_limit_high"]
        print(f"  the best possible on the same cases: {scored['limit']:.2f}")
        print(f"  above it by {scored['above_limit']:.2f} ({low:.2f} to {high:.2f}, paired)")
    elif "bracket" in scored:
        print("  the best possible on average: between {:.2f} and {:.2f}".format(*scored["bracket"]))
    else:
        print("  the best possible is not known")
    return 0


def score_recordings(truth: Path, said: Path, /, *, json_: bool = False) -> int:
    """Score verdicts on recordings of your own: the share of wrong ones, its interval over motors.

    Example: motor-classifiers score-recordings truth.csv said.json

    Args:
        truth: CSV with the columns file, motor and verdict.
        said: JSON of motor-classifiers predict --json, of motor-env diagnose --json, or of a method of your own.
        json_: Print the scores as JSON.
    """
    require_extra("sklearn", "classifiers")
    from motor_classifiers.contest.recordings import score_recordings as scored_of

    scored = scored_of(truth, said)
    if json_:
        print(console.json_text(scored))
        return 0
    for one in scored:
        wrong, low, high, silent = (100.0 * one[name] for name in ("wrong", "low", "high", "silent"))
        counts = f"{one['n_recordings']} recordings of {one['n_motors']} motors"
        print(
            f"{one['method']}, {counts}: wrong {wrong:.1f} % ({low:.1f} to {high:.1f}), no verdict {silent:.1f} %"
        )
    return 0
