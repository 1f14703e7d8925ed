"""The commands `task` and `score` of motor-bench."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from motor_env.common.errors import require_extra


def task(name: str, /, *, out: Path) -> int:
    """Write a frozen task: what it asks, labelled starts to learn from, and test cases without labels.

    Example: motor-classifiers task bench --out out/bench-task

    Args:
        name: bench, bench-full, field, operation, reference, severity, unknown or stream.
        out: Folder of task.json, train.npz and test.npz.
    """
    require_extra("sklearn", "classifiers")
    import numpy as np

    from motor_classifiers.scoring.frozen_tasks import load_task, task_facts
    from motor_env.common.files import replacing, write_text

    chosen = load_task(name)
    test = chosen.test()
    arrays: dict[str, dict[str, Any]] = {"train": chosen.learned(), "test": {"X": test.X}}
    for part, content in arrays.items():
        with replacing(out / f"{part}.npz") as temporary:
            np.savez(temporary, allow_pickle=False, **content)
    write_text(out / "task.json", json.dumps(task_facts(chosen), indent=1) + "\n")
    print(f"{chosen.title}: {chosen.n_train} starts to learn from, {len(test.X)} cases to answer: {out}")
    return 0


def score(task: str, answers: Path, /, *, json_: bool = False) -> int:
    """Score a file of answers to a frozen task, beside the best possible on the same cases.

    Example: motor-classifiers score bench out/answers.csv

    Args:
        task: The task that is answered.
        answers: CSV file: the column case, the row of the test case counted from 0, and those that task.json names.
        json_: Print the score as JSON.
    """
    require_extra("sklearn", "classifiers")
    from motor_classifiers.scoring.answer_files import read_answers, score_answers
    from motor_classifiers.scoring.frozen_tasks import load_task

    asked = load_task(task)
    scored = score_answers(asked, read_answers(answers, asked))
    if json_:
        print(json.dumps(scored, indent=1))
        return 0
    print(f"task {scored['task']} {scored['version']}, {scored['n_test']} cases")
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
