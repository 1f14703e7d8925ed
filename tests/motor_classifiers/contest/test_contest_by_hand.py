"""Costs, intervals and pages of motor-bench, on a handful of cases by hand."""

import base64
import hashlib
import json
import zlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from output_schema import follows

from motor_classifiers import load_task, score_submission, write_submission
from motor_classifiers.contest import submissions, tasks
from motor_classifiers.contest.leaderboard import file_of, page, ranks, read_scores
from motor_classifiers.contest.recordings import score_recordings
from motor_classifiers.contest.submissions import unpacked_costs
from motor_classifiers.contest.tasks import TASKS, frozen_digests

# Reaches in: the intervals by hand need the very weights that cases are drawn again with.
from motor_classifiers.scoring.metrics import compare, resampling_weights
from motor_classifiers.scoring.task import SEED, VERSION
from motor_env import InputError
from motor_env.console import json_text


def test_costs_of_the_linearised_area_by_hand() -> None:
    """Two known cases, and one and two of the unknown kinds; ties count half (DeLong et al. 1988)."""
    task = load_task("unknown")
    truth = np.array([0, 0, 1, 2, 3, 3])
    score = np.array([1.0, 3.0, 3.0, 4.0, 0.0, 2.0])
    # Kind 1: above 1, equal to 3: loses 1/4. Kind 2: above both. Kind 3: below both, and above one: loses 1 and 1/2.
    lost, lost_known = [[0.25], [0.0], [1.0, 0.5]], [[0.0, 0.5], [0.0, 0.0], [0.5, 1.0]]
    missing = np.mean([np.mean(one) for one in lost])
    known = [missing + 4 * (np.mean([row[n] for row in lost_known]) - missing) for n in range(2)]
    foreign = [missing + 4 * (value - np.mean(one)) / 3 for one in lost for value in one]
    costs = task.costs(truth, score[:, None])
    np.testing.assert_allclose(costs, [*known, *foreign])
    assert costs.mean() == pytest.approx(missing)


def test_costs_and_figures_of_the_other_tasks() -> None:
    severity = load_task("severity")
    costs = severity.costs(np.array([0.10, 0.20]), np.array([[0.13], [0.16]]))
    np.testing.assert_allclose(costs, [9.0, 16.0])  # points squared
    np.testing.assert_allclose(
        severity.figures(costs, np.array([[1.0, 1.0], [2.0, 0.0]])), [np.sqrt(12.5), 3.0]
    )
    bench = load_task("bench")
    answers = np.array([[0.3, 0.4, 0.1, 0.1, 0.1], [0.2, 0.2, 0.2, 0.2, 0.2]])
    assert bench.costs(np.array([1, 1]), answers).tolist() == [0.0, 1.0]
    assert bench.figures(np.array([0.0, 1.0]), np.array([[1.0, 1.0], [3.0, 1.0]])).tolist() == [50.0, 25.0]
    stream = load_task("stream")
    truth = np.array([0.2, 0.2, 0.2, np.nan, 0.2, np.nan, 0.2, 0.2])
    alarm = np.array([0.2, 0.3, 0.4, np.nan, 0.19, 0.0, 0.6, np.nan])
    np.testing.assert_allclose(stream.costs(truth, alarm[:, None]), [0.0, 0.5, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0])
    stream.check(np.array([[0.0], [np.nan]]))
    with pytest.raises(InputError, match=r"case 1: alarm_s must be >= 0 or nan, got -0\.1"):
        stream.check(np.array([[0.0], [-0.1]]))


def test_probabilities_at_their_bounds() -> None:
    bench = load_task("bench")
    bench.check(np.array([[1.0, 0.0, 0.0, 0.0, 0.0]]))
    for off, fits in ((0.995e-3, True), (1.005e-3, False), (-0.995e-3, True), (-1.005e-3, False)):
        answers = np.array([[0.2] * 5, [0.2 + off, 0.2, 0.2, 0.2, 0.2]])
        if fits:
            bench.check(answers)
        else:
            with pytest.raises(InputError, match="case 1: its probabilities must sum to 1"):
                bench.check(answers)
    with pytest.raises(InputError, match=r"case 0: healthy must be a probability from 0 to 1, got 1\.0005"):
        bench.check(np.array([[1.0005, 0.0, 0.0, 0.0, 0.0]]))
    with pytest.raises(InputError, match=r"case 0: bearing_10 must be a probability from 0 to 1, got 1\.5"):
        bench.check(np.array([[-0.5, 1.5, 0.0, 0.0, 0.0]])[:, [1, 1, 2, 3, 4]] * [0, 1, 1, 1, 1])


def test_the_names_of_the_public_splits_are_frozen() -> None:
    """A submission's card holds them (motor-bench 1.0): they name task, version and seed."""
    assert (SEED, VERSION) == (20261, "1.0")
    for name, task in TASKS.items():
        text = f"motor-bench 1.0 {name} 20261"
        assert task.draw_id == hashlib.sha256(text.encode()).hexdigest()[:16]
    told = load_task("stream").as_json()
    assert told["columns"] == ["case", "alarm_s"]
    assert (told["n_train"], told["n_test"], told["version"]) == (2000, 2000, "1.0")


def test_the_frozen_digests_are_the_shipped_ones() -> None:
    """The file itself: to freeze other data is to make another version of motor-bench."""
    digests = frozen_digests()
    text = json.dumps({part: digests[part] for part in ("small", "whole")}, sort_keys=True)
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == "889be570db47bc81"


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    few = {name: replace(task, n_train=60, n_test=120) for name, task in TASKS.items()}
    monkeypatch.setattr(tasks, "TASKS", few)
    monkeypatch.setattr("motor_classifiers.contest.leaderboard.TASKS", few)


@pytest.mark.usefixtures("small")
def test_a_score_is_the_mean_cost_with_its_paired_interval(tmp_path: Path) -> None:
    task = load_task("bench")
    cases = task.test()
    best = task.limit(cases.X)
    assert best is not None
    answers = np.eye(5)[np.where(np.arange(120) < 30, (cases.truth + 1) % 5, cases.truth)]
    write_submission(tmp_path, task, answers, {"method": "m" * 200, "authors": "a"})
    scored = score_submission(tmp_path)
    follows("motor-classifiers score", json_text(scored))
    assert scored["value"] == pytest.approx(25.0)
    weights = resampling_weights(120, 0, groups=cases.motor)
    figures = 100.0 * weights[:, :30].sum(axis=1) / 120
    assert (scored["low"], scored["high"]) == pytest.approx(tuple(np.quantile(figures[1:], [0.025, 0.975])))
    right = best.argmax(axis=1) == cases.truth
    assert scored["limit"] == pytest.approx(100.0 * (1.0 - right.mean()))
    gain = (np.arange(120) < 30).astype(float) - ~right
    differences = 100.0 * weights @ gain / 120
    assert scored["above_limit"] == pytest.approx(differences[0])
    ends = np.quantile(differences[1:], [0.025, 0.975])
    assert (scored["above_limit_low"], scored["above_limit_high"]) == pytest.approx(tuple(ends))
    assert unpacked_costs(scored).tolist() == (np.arange(120) < 30).astype(float).tolist()
    with pytest.raises(InputError, match="method of the card must be one line of at most 200 characters"):
        write_submission(tmp_path, task, answers, {"method": "m" * 201, "authors": "a"})


@pytest.mark.usefixtures("small")
def test_the_interval_of_a_submission_draws_motors_whole(tmp_path: Path) -> None:
    """Two starts of each motor are judged in the field: wrong together, they are one witness."""
    task = load_task("field")
    cases = task.test()
    wrong = np.arange(120) < 30
    answers = np.eye(5)[np.where(wrong, (cases.truth + 1) % 5, cases.truth)]
    write_submission(tmp_path, task, answers, {"method": "m", "authors": "a"})
    scored = score_submission(tmp_path)
    assert cases.motor is not None
    assert len(np.unique(cases.motor)) == 60
    weights = resampling_weights(120, 0, groups=cases.motor)
    ends = np.quantile(100.0 * weights[1:] @ wrong / weights[1:].sum(axis=1), [0.025, 0.975])
    assert (scored["low"], scored["high"]) == pytest.approx(tuple(ends))


@pytest.mark.usefixtures("small")
def test_a_table_may_be_as_large_as_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    task = load_task("bench")
    write_submission(tmp_path, task, np.full((120, 5), 0.2), {"method": "m", "authors": "a"})
    path = tmp_path / "answers.parquet"
    meta = pq.ParquetFile(path).metadata
    unpacked = sum(meta.row_group(n).total_byte_size for n in range(meta.num_row_groups))
    largest = max(path.stat().st_size, unpacked)
    for limit, fits in ((largest, True), (largest - 1, False)):
        monkeypatch.setattr(submissions, "LARGEST_TABLE_BYTES", limit)
        if fits:
            score_submission(tmp_path)
        else:
            with pytest.raises(InputError, match=r"is larger than|unpacks to more"):
                score_submission(tmp_path)
    monkeypatch.undo()


@pytest.mark.usefixtures("small")
def test_rows_may_come_in_any_order(tmp_path: Path) -> None:
    task = load_task("severity")
    answers = np.linspace(0.0, 0.3, 120)
    write_submission(tmp_path, task, answers, {"method": "m", "authors": "a"})
    before = score_submission(tmp_path)["value"]
    table = pq.read_table(tmp_path / "answers.parquet")
    pq.write_table(
        table.take(pa.array(np.random.default_rng(0).permutation(120))), tmp_path / "answers.parquet"
    )
    assert score_submission(tmp_path)["value"] == before


def kept(method: str, costs: Any, **more: Any) -> dict[str, Any]:
    packed = base64.b64encode(zlib.compress(np.asarray(costs, dtype=np.float32).tobytes())).decode()
    value = 100.0 * float(np.mean(costs))
    one = {
        "method": method,
        "authors": "who",
        "about": "what",
        "learned_from": "2,000 starts",
        "value": value,
        "low": value - 1.0,
        "high": value + 1.5,
    }
    return one | {"costs": packed} | more


def test_the_next_group_begins_with_the_first_that_is_told_apart() -> None:
    """Error rates 10, 12 and 20 %, 22 and 60 % of 400: ranks 1, 1, 3, 3, 5; a group is told from its best alone."""
    task = replace(TASKS["bench"], n_test=400)
    errors = {"a": 40, "b": 44, "c": 80, "d": 84, "e": 240}
    made = {name: kept(name, (np.arange(400) < count).astype(float)) for name, count in errors.items()}
    got = ranks(task, [made[name] for name in "edcba"])
    assert [(rank, one["method"]) for rank, one in got] == [(1, "a"), (2, "b"), (3, "c"), (4, "d"), (5, "e")]
    # Where the errors are not among the same cases, chance hides as much.
    rng = np.random.default_rng(0)
    shuffled = {
        name: kept(name, rng.permutation(np.arange(400) < count).astype(float))
        for name, count in errors.items()
    }
    got = ranks(task, [shuffled[name] for name in "edcba"])
    assert [rank for rank, _ in got] == [1, 1, 3, 3, 5]
    weights = resampling_weights(400, 0)
    value, low, high = compare(
        task, unpacked_costs(shuffled["b"]), unpacked_costs(shuffled["a"]), weights
    ).difference
    assert value == pytest.approx(1.0)
    assert low <= 0.0 < high


def test_a_chain_of_neighbours_is_no_group() -> None:
    """Error rates 10, 13 and 16.5 %: each is told from none beside it, but the last from the best, and begins anew."""
    task, rng = replace(TASKS["bench"], n_test=400), np.random.default_rng(0)
    made = [
        kept(name, rng.permutation(np.arange(400) < count).astype(float))
        for name, count in (("a", 40), ("b", 52), ("c", 66))
    ]
    assert [rank for rank, _ in ranks(task, made[1:])] == [1, 1]
    assert [rank for rank, _ in ranks(task, made)] == [1, 1, 3]


def test_motors_with_several_starts_are_drawn_whole() -> None:
    """Errors on 10 motors of 100 and on 18 others: four starts that always agree are worth one, and tell less apart."""
    motor = np.repeat(np.arange(100), 4)
    made = [kept("a", (motor < 10).astype(float)), kept("b", ((motor >= 10) & (motor < 28)).astype(float))]

    def ranked(starts: int) -> list[int]:
        task: Any = SimpleNamespace(
            n_test=400, recipe=SimpleNamespace(starts_per_motor=starts), test=lambda: SimpleNamespace(motor=motor),
            figures=TASKS["bench"].figures,
        )  # fmt: skip
        return [rank for rank, _ in ranks(task, made)]

    assert (ranked(1), ranked(4), ranked(2)) == ([1, 2], [1, 1], [1, 1])


@pytest.mark.usefixtures("small")
def test_a_page_has_what_stands_above_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    above = {"limit": 4.5, "above_limit": 5.25, "above_limit_low": -0.004, "above_limit_high": 7.125}
    costs = (np.arange(120) % 10 == 0).astype(float)
    text = page({"bench": [kept("mine", costs, **above)]})
    assert "120 cases, motor-bench 1.0. The best possible on the same cases: 4.50." in text
    assert (
        "| rank | method | by | error rate, % | above the best possible | learned from | what it is |" in text
    )
    assert "| 1 | mine | who | 10.00 (9.00 to 11.50) | 5.25 (0.00 to 7.12) | 2,000 starts | what |" in text
    plain = page({"bench": [kept("mine", costs)]})
    assert "| 1 | mine | who | 10.00 (9.00 to 11.50) | 2,000 starts | what |" in plain
    assert "above the best" not in plain
    bracketed = {"bench": replace(load_task("bench"), bracket=(4.0, 5.0))}
    with monkeypatch.context() as patch:
        patch.setattr("motor_classifiers.contest.leaderboard.TASKS", bracketed)
        assert "The best possible on average: between 4.00 and 5.00." in page(
            {"bench": [kept("mine", costs)]}
        )
    scored = kept("my-method_2", costs, task="bench")
    path = file_of(tmp_path, scored)
    assert path == tmp_path / "bench" / "my-method_2.json"
    path.parent.mkdir()
    path.write_text(json.dumps(scored))
    assert read_scores(tmp_path) == {"bench": [scored]}
    others = [
        "my method_2",
        "My-Method_2",
        "?!",
        "!?",
        "../x",
        "x" * 200,
        "x" * 100,
        "\u043c",
        "my-method_2.json",
    ]
    paths = {file_of(tmp_path, scored | {"method": name}) for name in others} | {path}
    assert len({str(each).lower() for each in paths}) == len(others) + 1
    assert {each.parent for each in paths} == {path.parent}
    assert max(len(each.name) for each in paths) < 130


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize(
    ("about", "shown"),
    [
        ("see [my code](https://evil.example/x) here", "see my code here"),
        ("![pixel](https://evil.example/x.png)!", "pixel!"),
        ("at https://evil.example/x, www.evil.example or FTP://evil.example", "at (link) (link) or (link)"),
        ("[a][b] [c]: d \\[e", r"\[a\]\[b\] \[c\]: d \\\[e"),
        ("[[x](y)](z)", r"\[x\](z)"),
        ("<img src=x> `code` a|b me@evil.example", "&lt;img src=x&gt; 'code' a/b me at evil.example"),
        ("support_vectors (Hahn et al. 2021), 20 %", "support_vectors (Hahn et al. 2021), 20 %"),
    ],
)
def test_a_strangers_text_links_nowhere(about: str, shown: str) -> None:
    text = page({"bench": [kept("mine", (np.arange(120) % 10 == 0).astype(float), about=about)]})
    assert f"| {shown} |\n" in text


def test_shares_of_recordings_are_drawn_by_motor(tmp_path: Path) -> None:
    """Motor 1 has three recordings, one of them wrong; motor 2 one, which is right."""
    rows = [("a", 1, "healthy"), ("b", 1, "bearing"), ("c", 1, "winding"), ("d", 2, "healthy")]
    (tmp_path / "t.csv").write_text("file,motor,verdict\n" + "".join(f"{f},{m},{v}\n" for f, m, v in rows))
    said = [{"file": f, "verdict": v} for f, _, v in rows]
    said[0] = {"file": "a"}  # no verdict counts as wrong
    (tmp_path / "s.json").write_text(json.dumps(said))
    (got,) = score_recordings(tmp_path / "t.csv", tmp_path / "s.json")
    assert (got["wrong"], got["silent"], got["n_recordings"], got["n_motors"]) == (0.25, 0.25, 4, 2)
    assert (got["low"], got["high"]) == pytest.approx((0.0, 1 / 3))  # motor 2 twice, or motor 1 twice
