"""Do the tests notice a small change of the code? Draws such changes, makes them one at a time, and runs the tests.

python benchmarks/mutants.py draw     # the list: benchmarks/mutants.json, four changes a room
python benchmarks/mutants.py run      # some hours on two cores; resumes; results in out/mutants/results.json
python benchmarks/mutants.py run --only envs operation/3 --anew
python benchmarks/mutants.py show
python benchmarks/mutants.py draw --seed 7 --list out/other.json    # another list; `run` and `show` take it, too

A change is a sign, an off-by-one, a quantile of another level, a constant that is 1 % off, the scale of a reward, a
swapped label, a dropped factor, or a square for its root. Sites are drawn by a seeded generator over the syntax trees.
Messages, pictures' styles and annotations are left out: nothing is decided there.

`draw` keeps what is in the list already. Where the line of a change no longer stands in the code, another change is
drawn in its place. A change that no test can notice carries the reason as `equivalent`.

Each change is made in a copy of the working tree, in which all tests have passed without one. First the room's own
quick tests run, then all.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
LIST = ROOT / "benchmarks" / "mutants.json"
WORK = ROOT / "out" / "mutants"
TREE = WORK / "tree"
PACKAGES = {"motor_env": "", "motor_datasets": "datasets", "motor_classifiers": "classifiers"}
SEED = 30
A_ROOM = 4
KEPT = {"__pycache__", ".pytest_cache"}
LIMIT_S = 1800.0
Results = dict[str, dict[str, object]]
QUANTILE = re.compile(r"quantile|percentile|ppf|isf|ndtri|chdtri|gammaincc?inv|stdtrit", re.IGNORECASE)
LEVEL = re.compile(r"LEVEL|RATE|QUANTILE|CONFIDENCE|COVERAGE|POSTERIOR|CERTAIN|SURE|SHARE|CHANCE|rate|level")
REWARD = re.compile(r"reward|cost|penalt|charge|loss|score")
QUIET = re.compile(
    r"print|warn|_LOG|logger|legend|annotate|set_|subplot|figure|plot|text|fill_between|ax[hv]line|grid"
)
TIMES = re.compile(r"perf_counter|process_time|timeout|monotonic|sleep")
NORMAL = {1.64: 1.28, 1.65: 1.28, 1.96: 1.64, 2.33: 1.96, 2.58: 1.96, 3.29: 2.58}
STYLE = {
    "alpha",
    "color",
    "dpi",
    "figsize",
    "fontsize",
    "linewidth",
    "lw",
    "ms",
    "pad",
    "rotation",
    "s",
    "zorder",
}
DRAWN = {"plotting.py", "pictures.py", "plots.py", "rendering.py", "paper_figures.py"}


@dataclass(frozen=True)
class Mutant:
    """One change: in which line of which function what stands, and what is put in its place."""

    name: str
    kind: str
    file: str
    line: str
    before: str
    after: str
    place: int = 0
    function: str = ""
    equivalent: str = ""

    @property
    def room(self) -> str:
        """The room in which it is made."""
        return self.name.rpartition("/")[0]


def room_of(file: Path) -> str:
    """`diagnosis/estimation` for motor_env/diagnosis/estimation/ekf.py; the package's name for what lies at its top."""
    parts = file.parts[file.parts.index(next(p for p in file.parts if p in PACKAGES)) :]
    depth = 2 if parts[1] == "diagnosis" else 1
    inner = parts[1 : min(depth + 1, len(parts) - 1)]
    if parts[0] == "motor_env":
        return "/".join(inner) or "motor_env"
    return "/".join((parts[0], *inner))


def sources() -> dict[str, list[Path]]:
    """The modules of each room."""
    rooms: dict[str, list[Path]] = {}
    for package, folder in PACKAGES.items():
        for file in sorted((ROOT / folder / package).rglob("*.py")):
            if file.name not in DRAWN and not file.name.startswith("__"):
                rooms.setdefault(room_of(file.relative_to(ROOT)), []).append(file)
    return rooms


def _no_number(node: ast.expr) -> bool:
    """Whether arithmetic with it means something else: lists, texts, sets, paths."""
    if isinstance(node, ast.IfExp):
        return _no_number(node.body) or _no_number(node.orelse)
    if isinstance(node, ast.Call):
        return ast.unparse(node.func) in ("list", "set", "tuple", "str", "Path", "dict")
    kinds = ast.JoinedStr | ast.List | ast.Tuple | ast.ListComp | ast.Set | ast.SetComp | ast.Dict
    return isinstance(node, kinds) or (isinstance(node, ast.Constant) and isinstance(node.value, str))


def _counts(node: ast.expr) -> bool:
    """Whether it is a whole number, as far as its syntax tells: only there `<` and `<=` differ."""
    text = ast.unparse(node)
    return bool(re.fullmatch(r"-?\d+", text) or re.search(r"\blen\(|\.size\b|\.shape\[|count", text))


def _of_arithmetic(node: ast.AST) -> Iterator[tuple[str, ast.expr]]:
    """Signs, factors, and squares for their roots."""
    if isinstance(node, ast.BinOp) and not _no_number(node.left) and not _no_number(node.right):
        if isinstance(node.op, ast.Add | ast.Sub):
            other = ast.Sub() if isinstance(node.op, ast.Add) else ast.Add()
            yield "sign", ast.BinOp(node.left, other, node.right)
        if isinstance(node.op, ast.Mult | ast.Div):
            yield "factor", node.left
        if isinstance(node.op, ast.Mult):
            yield "factor", node.right
        if isinstance(node.op, ast.Pow) and isinstance(node.right, ast.Constant):
            yield "root", node.left
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        yield "sign", node.operand
    if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("sqrt") and len(node.args) == 1:
        yield "root", node.args[0]


def _of_choices(node: ast.AST) -> Iterator[tuple[str, ast.expr]]:
    """Borders of a comparison, and which of two is taken."""
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        swapped = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}.get(type(node.ops[0]))
        if swapped is not None and any(map(_counts, (node.left, *node.comparators))):
            yield "off_by_one", ast.Compare(node.left, [swapped()], node.comparators)
    if isinstance(node, ast.IfExp):
        yield "label", ast.IfExp(node.test, node.orelse, node.body)
    if isinstance(node, ast.Dict) and len(node.values) > 1:
        first, second, *rest = node.values
        if isinstance(first, ast.Constant | ast.Attribute) and isinstance(
            second, ast.Constant | ast.Attribute
        ):
            yield "label", ast.Dict(node.keys, [second, first, *rest])


def _of_constants(node: ast.AST, parents: list[ast.AST]) -> Iterator[tuple[str, ast.expr]]:
    """A place or a count that is one off, another level of a quantile, a number that is 1 % off."""
    above = parents[-1] if parents else node
    if not isinstance(node, ast.Constant):
        return
    counted = isinstance(above, ast.Subscript | ast.Slice | ast.Compare) or (
        isinstance(above, ast.Call) and ast.unparse(above.func) in ("range", "np.arange")
    )
    if type(node.value) is int and counted:
        yield "off_by_one", ast.Constant(node.value + 1)
    if type(node.value) is float and 1e-6 < abs(node.value) < 1e6:
        calls = [ast.unparse(each.func) for each in parents[-2:] if isinstance(each, ast.Call)]
        names = [ast.unparse(each.targets[0]) for each in parents[-2:] if isinstance(each, ast.Assign)]
        if 0.0 < node.value < 1.0 and (any(map(QUANTILE.search, calls)) or any(map(LEVEL.search, names))):
            level = 1.0 - 2.0 * (1.0 - node.value) if node.value > 0.5 else 2.0 * node.value
            yield "quantile", ast.Constant(round(level, 6))
        if round(node.value, 2) in NORMAL:
            yield "quantile", ast.Constant(NORMAL[round(node.value, 2)])
        yield "constant", ast.Constant(float(f"{node.value * 1.01:.6g}"))


def _of_rewards(node: ast.AST, parents: list[ast.AST]) -> Iterator[tuple[str, ast.expr]]:
    """The scale of what is paid, where it is assigned or returned."""
    above = parents[-1] if parents else node
    if not isinstance(above, ast.Assign | ast.AugAssign | ast.Return) or node is not above.value:
        return
    scope = next((each.name for each in reversed(parents) if isinstance(each, ast.FunctionDef)), "")
    target = scope if isinstance(above, ast.Return) else ast.unparse(above).partition("=")[0]
    arithmetic = ast.Add | ast.Sub | ast.Mult | ast.Div
    if isinstance(node, ast.BinOp) and isinstance(node.op, arithmetic) and REWARD.search(target):
        yield "reward", ast.BinOp(node, ast.Mult(), ast.Constant(0.9))


def changes(node: ast.AST, parents: list[ast.AST]) -> Iterator[tuple[str, ast.expr]]:
    """What can be put in the place of a piece of syntax: kind and expression."""
    yield from _of_arithmetic(node)
    yield from _of_choices(node)
    yield from _of_constants(node, parents)
    yield from _of_rewards(node, parents)


def _skipped(node: ast.AST, parents: list[ast.AST]) -> bool:
    """Whether nothing is decided below here: messages, annotations, styles of pictures, decorators, times taken."""
    above = parents[-1] if parents else None
    if isinstance(node, ast.Raise | ast.JoinedStr | ast.Import | ast.ImportFrom | ast.Assert):
        return True
    if isinstance(node, ast.Assign | ast.AnnAssign | ast.Return | ast.Expr):
        return bool(TIMES.search(ast.unparse(node)))
    if isinstance(node, ast.keyword | ast.Call):
        name = node.arg if isinstance(node, ast.keyword) else ast.unparse(node.func).rpartition(".")[2]
        return name in STYLE if isinstance(node, ast.keyword) else bool(QUIET.search(name or ""))
    annotation = getattr(above, "returns", getattr(above, "annotation", None))
    return node is annotation or node in getattr(above, "decorator_list", [])


def _walk(node: ast.AST, parents: list[ast.AST]) -> Iterator[tuple[ast.AST, list[ast.AST]]]:
    if _skipped(node, parents):
        return
    yield node, parents
    for child in ast.iter_child_nodes(node):
        yield from _walk(child, [*parents, node])


def sites(root: Path, name: str) -> Iterator[tuple[Mutant, int, slice]]:
    """Changes of a file of a tree that stand in one line; the number of the line, and the bytes that are replaced."""
    text = (root / name).read_text(encoding="utf-8")
    lines = text.encode().splitlines()
    seen: dict[tuple[str, ...], int] = {}
    for node, parents in _walk(ast.parse(text), []):
        if not isinstance(node, ast.expr) or node.lineno != node.end_lineno:
            continue
        line, place = lines[node.lineno - 1], slice(node.col_offset, node.end_col_offset)
        before = line[place].decode()
        scope = ".".join(e.name for e in parents if isinstance(e, ast.FunctionDef | ast.ClassDef))
        for kind, new in changes(node, parents):
            after = ast.unparse(ast.fix_missing_locations(ast.Expression(new)))
            after = after if isinstance(new, ast.Constant | ast.Name | ast.Dict) else f"({after})"
            key = (kind, scope, line.decode().strip(), before, after)
            seen[key] = seen.get(key, -1) + 1
            yield (
                Mutant("", kind, name, line.decode().strip(), before, after, seen[key], scope),
                node.lineno - 1,
                place,
            )


def mutated(mutant: Mutant, root: Path) -> str | None:
    """The text of the file with the change; None where its line no longer stands in that function."""
    file, wanted = root / mutant.file, replace(mutant, name="", equivalent="")
    for site, number, place in sites(root, mutant.file) if file.exists() else ():
        if site == wanted:
            lines = file.read_bytes().splitlines(keepends=True)
            line = lines[number]
            lines[number] = line[: place.start] + mutant.after.encode() + line[place.stop :]
            return b"".join(lines).decode()
    return None


def load(path: Path) -> list[Mutant]:
    """A list that was drawn."""
    return [Mutant(**each) for each in json.loads(path.read_text(encoding="utf-8"))] if path.exists() else []


def draw(path: Path, seed: int) -> None:
    """Fill every room up to its number, kinds before sites, so that rare kinds are among them."""
    kept: dict[str, list[Mutant]] = {}
    for mutant in load(path):
        if mutated(mutant, ROOT) is not None:
            kept.setdefault(mutant.room, []).append(mutant)
    chosen: list[Mutant] = []
    for number, (room, files) in enumerate(sorted(sources().items())):
        rng = np.random.default_rng([seed, number])
        there = kept.get(room, [])
        by_kind: dict[str, list[Mutant]] = {}
        for file in files:
            for each, _, _ in sites(ROOT, str(file.relative_to(ROOT))):
                by_kind.setdefault(each.kind, []).append(each)
        taken = {(each.file, each.function, each.line) for each in there}
        names = iter(n for n in range(1, 99) if f"{room}/{n}" not in {each.name for each in there})
        while len(there) < A_ROOM and by_kind:
            kind = sorted(by_kind)[rng.integers(len(by_kind))]
            one = by_kind[kind].pop(rng.integers(len(by_kind[kind])))
            if not by_kind[kind]:
                del by_kind[kind]
            if (one.file, one.function, one.line) not in taken:
                taken.add((one.file, one.function, one.line))
                there.append(replace(one, name=f"{room}/{next(names)}"))
        chosen += there
    rows = [{key: value for key, value in asdict(each).items() if value != ""} for each in chosen]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(rows, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    print(f"{len(chosen)} changes in {len(sources())} rooms: {path}")


def copy_tree(target: Path) -> None:
    """Copy the tracked and new files of the working tree; what was compiled there stays."""
    listed = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    names = subprocess.run(listed, cwd=ROOT, capture_output=True, check=True, text=True).stdout.split("\0")
    present = {
        name: (ROOT / name).read_bytes() for name in sorted(filter(None, names)) if (ROOT / name).is_file()
    }
    for path in [path for path in target.rglob("*") if path.is_file() and not KEPT & {*path.parts}]:
        if str(path.relative_to(target)) not in present:
            path.unlink()
    for name, content in present.items():
        path = target / name
        if not path.exists() or path.read_bytes() != content:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
            path.chmod((ROOT / name).stat().st_mode)


def run_tests(tree: Path, tests: Iterable[str], *options: str) -> tuple[bool, list[str]]:
    """Whether the quick tests of a tree pass, and those that fail."""
    paths = [str(tree / folder / "") for folder in PACKAGES.values()]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-m", "not long", "--tb=no", *options, *tests]
    try:
        done = subprocess.run(
            command,
            check=False,
            cwd=tree,
            env=environment,
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
        )
    except subprocess.TimeoutExpired:
        return False, ["it did not end"]
    failed = re.findall(r"^(?:FAILED|ERROR) ([^\s]+(?:\[.*?\])?)(?: - .*)?$", done.stdout, re.MULTILINE)
    return done.returncode in (0, 5), failed or ([] if done.returncode in (0, 5) else ["pytest itself"])


def own_tests(mutant: Mutant) -> list[str]:
    """The quick tests of its room; of the modules beside the rooms, those beside the folders."""
    package = "" if mutant.room.startswith("motor_") else "motor_env/"
    if mutant.room == "motor_env":
        return sorted(str(file.relative_to(TREE)) for file in TREE.glob("tests/motor_env/test_*.py"))
    folder = Path(f"tests/{package}{mutant.room}")
    if folder.name == "diagnosis":  # the verbs; each room below has a folder of its own
        return sorted(str(file.relative_to(TREE)) for file in (TREE / folder).glob("test_*.py"))
    return [str(folder)] if (TREE / folder).exists() else []


def attempt(mutant: Mutant, tests: list[str], workers: int) -> tuple[bool, list[str]]:
    """Run tests with a change in the copy."""
    file, text = TREE / mutant.file, mutated(mutant, TREE)
    if text is None:
        raise ValueError(f"{mutant.name}: its line is gone; draw again")
    before = file.read_bytes()
    file.write_text(text, encoding="utf-8")
    try:
        return run_tests(TREE, tests, "-x", "-n", str(workers))
    finally:
        file.write_bytes(before)


def try_all(mutants: list[Mutant], results: Results, out: Path, workers: int) -> None:
    """Try those of which nothing is known yet: the room's own tests, then all."""
    copy_tree(TREE)
    print("all quick tests without a change, which also compiles everything", flush=True)
    passed, failed = run_tests(TREE, ["tests"], "-n", str(workers))
    if not passed:
        raise SystemExit(f"they fail without a change: {failed[:5]}")
    out.parent.mkdir(parents=True, exist_ok=True)
    for mutant in (each for each in mutants if each.name not in results):
        found: dict[str, object] = {"state": "survived"}
        for tests in filter(None, (own_tests(mutant), ["tests"])):
            passed, by = attempt(mutant, tests, workers)
            if not passed:
                found = {"state": "killed", "by": " ".join(by[:1])}
                break
        results[mutant.name] = {"before": mutant.before, "after": mutant.after, **found}
        out.write_text(json.dumps(dict(sorted(results.items())), indent=1, ensure_ascii=False) + "\n")
        print(f"{mutant.name:32} {found['state']:9} {mutant.kind:10} {found.get('by', '')}", flush=True)


def show(mutants: list[Mutant], out: Path) -> None:
    """How many survive, and which."""
    results = json.loads(out.read_text(encoding="utf-8"))
    states = [each["state"] for each in results.values()]
    print(", ".join(f"{states.count(state)} {state}" for state in sorted(set(states))))
    for mutant in mutants:
        if results.get(mutant.name, {}).get("state") == "survived":
            print(f"{mutant.name} {mutant.file} {mutant.function}: {mutant.line}")
            print(f"    {mutant.before} -> {mutant.after}  {mutant.equivalent}")


def main() -> None:
    """Parse, call, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("command", choices=("draw", "run", "show"))
    parser.add_argument("--only", nargs="*", default=[], help="rooms, or single changes such as operation/3")
    parser.add_argument("--anew", action="store_true", help="forget what is known of them")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=SEED, help="of draw")
    parser.add_argument("--list", type=Path, default=LIST, help="the changes")
    parser.add_argument("--out", type=Path, default=WORK / "results.json", help="what is known of them")
    options = parser.parse_args()
    if options.command == "draw":
        draw(options.list, options.seed)
        return
    mutants = load(options.list)
    if options.command == "run":
        some = [each for each in mutants if not options.only or {each.name, each.room} & set(options.only)]
        gone = [each.name for each in some if mutated(each, ROOT) is None]
        if gone:
            raise SystemExit(f"the lines of {', '.join(gone)} no longer stand in the code: draw again")
        results: Results = json.loads(options.out.read_text()) if options.out.exists() else {}
        if options.anew:
            results = {name: known for name, known in results.items() if name not in {m.name for m in some}}
        try_all(some, results, options.out, options.workers)
    show(mutants, options.out)


if __name__ == "__main__":
    main()
