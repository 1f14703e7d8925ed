"""Writes the pages of the site that follow from the code: one for each family of ids and each group of public names.

`conf.py` calls `write_pages` when the site is built; nothing of it is kept in the repository.
"""

import ast
import dataclasses
import inspect
import json
import re
from importlib import import_module
from itertools import groupby, pairwise
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import gymnasium as gym
import matplotlib.image
import numpy as np
from gymnasium.envs.registration import EnvSpec
from matplotlib import pyplot as plt

import motor_env
from motor_env.envs import Lqg, MonitorOptions
from motor_env.envs.stepping import DECLARE_ABOVE

DOCS = Path(__file__).parent
RESULTS = DOCS.parent / "benchmarks" / "results" / "reference"
FAMILIES = ("Monitor-v0", "Probe-v0", "Drive-v0", "Maintain-v0")
PACKAGES = ("motor_env", "motor_env.envs", "motor_datasets", "motor_classifiers")
FEATURES = {
    "measured": "what the sensor reads",
    "estimated": "what the Kalman filter of the healthy motor expects it to be",
    "innovation": "what the sensor reads minus what the filter expected, in standard deviations",
    "fast": "mean of the innovation over the last 1 ms",
    "slow": "mean of the innovation over the last 10 ms",
    "excess": "how much the power of the innovation exceeds that of noise, over 10 ms",
    "voltage": "the supply's voltage during the last step",
    "time": "share of the horizon that has passed",
    "evidence": "a CUSUM of the log-likelihood ratio of the smallest fault of this kind, divided by 10; never below 0",
}
WORDS = {
    "DriveEnv": FEATURES
    | {
        "slow": "weighted mean of the innovation over the last 0.3 s, scaled to a standard deviation of 1",
        "estimated_load": "load beyond the known one, as the filter of the healthy motor estimates it",
        "estimated_temperature": "rise of temperature that a healthy winding would have, as a share of the limit",
        "scale": "share of the profile that is asked for now",
        "profile": "scaled profile so many steps ahead, in units of the top speed",
    }
}
"""Where the numbers of an environment mean something else."""
LEVELS = (
    ("trivial", "always", "tab:red"),
    ("textbook", "textbook", "tab:orange"),
    ("best", "best known", "tab:green"),
)
"""Scores beside the learning curves: file, column of the table of reference scores, colour."""


API_HEAD = """# All public names

Each group has a page with an example, every argument and every method.
What is not listed here is private and may change.
"""


def table(head: list[str], rows: list[list[object]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell).replace("|", "\\|") for cell in row) + " |" for row in lines)


def sections(docstring: str) -> dict[str, str]:
    """Parts of a docstring between its headings; the part before the first has the name ''."""
    parts = re.split(r"^## (.*)\n", docstring.split("\nArgs:", maxsplit=1)[0], flags=re.MULTILINE)
    return {"": parts[0].strip()} | {
        name: text.strip() for name, text in zip(parts[1::2], parts[2::2], strict=True)
    }


def attributes(cls: type) -> dict[str, str]:
    """What the docstring of a class says of its attributes."""
    text = inspect.getdoc(cls) or ""
    block = text.partition("Attributes:\n")[2].partition("\n\n")[0]
    pairs = re.findall(r"^    (\w+): (.*(?:\n     .*)*)", block, flags=re.MULTILINE)
    return {name: " ".join(said.split()) for name, said in pairs}


def options_table(options: Any) -> str:
    """Every option, its value in this environment, and what it is."""
    said: dict[str, str] = {}
    for cls in reversed(type(options).__mro__):
        said |= {name: text for name, text in attributes(cls).items() if not text.startswith("see `")}
    values = {field.name: getattr(options, field.name) for field in dataclasses.fields(options)}
    if "recipe" in values:
        values["recipe"] = values["recipe"].name
    if values.get("motor") == motor_env.PAPER_MOTOR:
        values["motor"] = "PAPER_MOTOR"
    return table(
        ["option", "value here", "what it is"], [[f"`{n}`", f"`{v}`", said[n]] for n, v in values.items()]
    )


def observation_table(env: Any) -> str:
    """Every number of an observation; what it is, where the docstring does not say it name by name."""
    space, names = env.observation_space, env.observed
    words = WORDS.get(type(env).__name__, FEATURES)
    texts = [words.get(name, words.get(name.split("_")[0], "")) for name in names]
    rows = [
        [n, f"`{name}`", texts[n], f"{space.low[n]:.4g}", f"{space.high[n]:.4g}"]
        for n, name in enumerate(names)
    ]
    said = any(row[2] for row in rows)
    head = ["", "name", "what it is", "least", "most"]
    return table(*([head, rows] if said else [head[:2] + head[3:], [row[:2] + row[3:] for row in rows]]))


def action_table(env: Any) -> str:
    """Every action of a list of actions, or every number of a continuous one."""
    if not isinstance(env.action_space, gym.spaces.Discrete):
        offset = f"offset of the voltage from -1 to 1, in units of {env.options.max_offset_v:g} V"
        declaring = "above {:g} and the largest of the declaring numbers: declares {}; the episode ends"
        kinds = [declaring.format(DECLARE_ABOVE, kind) for kind in env.setup.kinds]
        return table(["number", "meaning"], [[n, meaning] for n, meaning in enumerate([offset, *kinds])])
    rows = []
    for n, (offset, declared) in enumerate(zip(env.setup.offsets_v, env.setup.declarations, strict=True)):
        if declared:
            times = env.options.confirm_steps
            ends = (
                f"declared once it is chosen in {times} steps in a row" if times > 1 else "the episode ends"
            )
            meaning = f"{env.setup.kinds[int(declared) - 1]}; {ends}"
        else:
            meaning = f"apply {offset:+g} V for a step" if offset else "wait"
        rows.append([n, meaning])
    return table(["action", "meaning"], rows)


def reward_table(options: Any) -> str:
    """What pays and what costs."""
    events = [
        ("the right kind is declared after the onset", options.correct_reward),
        ("silence until the horizon, and there was no fault", options.silent_reward),
        ("a kind is declared before anything has happened", -options.false_alarm_cost),
        ("another kind than the fault's is declared after the onset", -options.wrong_kind_cost),
        ("silence until the horizon, and there was a fault", -options.miss_cost),
        ("each second between onset and declaration", -options.delay_cost_per_s),
    ]
    if options.moves_voltage:
        events.append(
            ("an offset of 1 V, each second; it grows with the square", -options.probe_cost_per_v2_s)
        )
    return table(["event", "reward"], [[event, f"{reward:+g}"] for event, reward in events])


def probing(env: Any, step: int, _: Any) -> Any:
    """Moves the voltage now and then, where it can be moved."""
    moved = env.options.moves_voltage and step % 15 < 2
    if isinstance(env.action_space, gym.spaces.Discrete):
        return 1 + step % 2 if moved else 0
    return np.where(np.arange(env.action_space.shape[0]) == 0, moved * 0.5, 0.0)


def replacing(env: Any, step: int, observation: Any) -> int:
    """Inspects once, and replaces the bearing when it may fail."""
    return 2 if observation[env.observed.index("risk")] > 0.01 else int(step == 20)


def driving(env: Any, step: int, observation: Any) -> Any:
    """Drives with a bank of filters, which is kept in the environment; where only decisions are asked for, limps."""
    if isinstance(env.action_space, gym.spaces.Discrete):
        return int(observation[env.observed.index("estimated_load")] > 0.3)
    if step == 0:
        env.driver = Lqg(env.setup, levels=8)
        env.driver.start(1)
    return env.driver.act(observation[None])[0]


ACTS = {"MaintainEnv": replacing, "DriveEnv": driving}
"""What is done in the picture of an environment."""


def picture(spec: EnvSpec, path: Path) -> None:
    """The screen at the end of an episode, with a fault where there may be none."""
    env = gym.make(spec.id, render_mode="rgb_array")
    observation, info = env.reset(seed=1)
    while info.get("onset_sample", info.get("onset_step", 0)) < 0:
        observation, info = env.reset()
    play = ACTS.get(type(env.unwrapped).__name__, probing)
    step, over = 0, False
    while not over:
        observation, _, over, _, _ = env.step(play(env.unwrapped, step, observation))
        step += 1
    matplotlib.image.imsave(path, env.render())
    env.close()


def curves(name: str) -> str:
    """Draw the learning curves that are kept of an id beside its other scores; their picture, if there are any."""
    kept = RESULTS / name
    runs = [json.loads(each.read_text(encoding="utf-8"))["curve"] for each in sorted(kept.glob("ppo-*.json"))]
    if not runs:
        return ""
    figure, axes = plt.subplots(figsize=(6.4, 3.2), layout="constrained")
    for run in runs:
        steps, returns = ([point[key] for point in run] for key in ("steps", "return"))
        axes.plot(steps, returns, color="tab:blue", alpha=0.7, marker=".")
    for method, word, colour in LEVELS:
        level = json.loads((kept / f"{method}.json").read_text(encoding="utf-8"))["return"]
        axes.axhline(level, color=colour, linestyle="--", linewidth=1.2, label=word)
    axes.set(xlabel="steps of training", ylabel="mean return")
    figure.legend(loc="outside right upper", frameon=False)
    figure.savefig(DOCS / "environments" / f"{name}-curve.png", dpi=110)
    plt.close(figure)
    return f"![Learning curves of PPO with its defaults on {name}, a line a seed]({name}-curve.png)"


def score_rows(names: list[str]) -> str:
    """The head of the first table of reference scores, that of policies, and its rows of these ids."""
    text = (DOCS / "reference-scores.md").read_text(encoding="utf-8").partition("\n| id | best known ")[0]
    head = re.findall(r"^\| id \| random .*\n\|---.*\n", text, flags=re.MULTILINE)
    rows = [
        f"| {name} {rest}"
        for name in names
        for rest in re.findall(rf"^\| \[{name}\]\(\S+ (.*\n)", text, re.MULTILINE)
    ]
    return "".join([*head, *rows])


def motor_parts(env: Any) -> list[str]:
    """What is drawn in an environment around one running motor."""
    options, recipe = env.options, env.options.recipe
    step_ms = 1000 * options.dt_s * options.samples_per_step
    return [
        f"*An episode with a fault: {options.n_steps} steps of {step_ms:g} ms. Nobody declares it.*",
        f"Motors and faults are drawn from the recipe `{recipe.name}`. Classes by weight:",
        table(
            ["kind", "severity", "weight"],
            [[each.kind or "healthy", f"{each.severity:.1%}", f"{each.weight:g}"] for each in recipe.classes],
        ),
    ]


def screen_of(name: str) -> str:
    """The picture of an id."""
    return f"![Screen of {name} at the end of an episode]({name}.png)"


def tables_of(env: Any) -> dict[str, str]:
    """What is seen, done and paid in an environment."""
    tables = {"Observation Space": observation_table(env)}
    if isinstance(env.options, MonitorOptions):
        tables |= {"Action Space": action_table(env), "Rewards": reward_table(env.options)}
    return tables


def differences(spec: EnvSpec) -> str:
    """What an id has that the first of its family has not, in words or as options."""
    return ", ".join(f"`{key}={value!r}`" for key, value in spec.kwargs.items()) or "continuous actions"


def variant(spec: EnvSpec, base: Any) -> list[str]:
    """What an id has that the first of its family has not."""
    env, name = gym.make(spec.id).unwrapped, spec.id.split("/")[1]
    watched = isinstance(env.options, MonitorOptions)
    parts = [
        f"## {name}",
        f"Differs by {differences(spec)}.",
        screen_of(name),
        *(motor_parts(env) if watched else []),
    ]
    known = tables_of(base)
    for heading, made in tables_of(env).items():
        parts += [f"**{heading}**", made] if made and made != known.get(heading) else []
    return [*parts, curves(name)]


def family_page(name: str, specs: list[EnvSpec]) -> str:
    """The specification of an id: what its class's docstring says, its numbers, and what its variants change."""
    (first,) = [spec for spec in specs if spec.id == f"motor_env/{name}"]
    others = [spec for spec in specs if spec is not first]
    env = gym.make(first.id).unwrapped
    said = sections(inspect.getdoc(type(env)) or "")
    parts = [
        f"# {name} and its variants",
        said.pop(""),
        f'```python\nimport gymnasium as gym\n\nenv = gym.make("motor_env:{first.id}")\n```',
        screen_of(name),
        *(motor_parts(env) if isinstance(env.options, MonitorOptions) else []),
        table(
            ["id", "differs by", "`reward_threshold`"],
            [
                [
                    f"`{spec.id}`",
                    "" if spec is first else differences(spec),
                    f"{spec.reward_threshold:+.3f}",
                ]
                for spec in [first, *others]
            ],
        ),
    ]
    for heading, text in said.items():
        parts += [f"## {heading}", text]
    parts += [
        "## Options",
        "Any of them by name in `gym.make`; all are checked, and a wrong value is named.",
        options_table(env.options),
        *(part for spec in others for part in variant(spec, env)),
        "## Scores",
        "All ids beside each other, and what the columns mean: [reference scores](../reference-scores.md).",
        score_rows([spec.id.split("/")[1] for spec in [first, *others]]),
        curves(name),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def stub_of(package: ModuleType) -> Path:
    """The file that lists a package's public names."""
    return Path(str(package.__file__)).with_suffix(".pyi")


def homes(stub: Path) -> dict[str, str]:
    """Public names and the modules, relative to the package, that define them."""
    tree = ast.parse(stub.read_text(encoding="utf-8"))
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    return {alias.name: str(node.module) for node in imports for alias in node.names}


def summary(package: ModuleType, name: str, home: str) -> str:
    """First sentence of what a name's docstring says; a constant's docstring is the string below it."""
    thing = getattr(package, name)
    text = (
        thing.__doc__
        if callable(thing)
        else constant_docstring(import_module(f"{package.__name__}.{home}"), name)
    )
    return " ".join((text or "").strip().split("\n\n")[0].split()).replace("|", "\\|")


def constant_docstring(module: ModuleType, name: str) -> str:
    """The string that stands below an assignment."""
    body = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8")).body
    for node, after in pairwise(body):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        named = any(isinstance(target, ast.Name) and target.id == name for target in targets)
        if named and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            return str(after.value.value)
    return ""


class PublicName(NamedTuple):
    """A name that a user imports: where it is described, its path, what it stands for, and what is said of it."""

    page: str
    path: str
    thing: Any
    said: str


def public_names() -> list[PublicName]:
    """All of them, page by page."""
    listed = []
    for package in map(import_module, PACKAGES):
        for name, home in homes(stub_of(package)).items():
            room = home.split(".")[0] if package is motor_env else ""
            page, path = f"{package.__name__}.{room}".rstrip("."), f"{package.__name__}.{name}"
            listed.append(PublicName(page, path, getattr(package, name), summary(package, name, home)))
    return sorted(
        listed, key=lambda each: (not each.page.startswith("motor_env"), each.page, each.path.lower())
    )


def directive(each: PublicName, paths: dict[int, str]) -> str:
    """What makes autodoc describe one public name; `paths` has the path of each by its `id`."""
    if not isinstance(each.thing, type):
        return (
            f".. autofunction:: {each.path}\n"
            if callable(each.thing)
            else f".. py:data:: {each.path}\n\n   {each.said}\n"
        )
    ancestors = each.thing.__mro__[1:]
    above = {member for ancestor in ancestors for member in vars(ancestor)}
    hidden = sorted({*getattr(each.thing, "_fields", ()), *(above & set(vars(each.thing)))})
    hidden = [member for member in hidden if not member.startswith("_")]
    left_out = f"   :exclude-members: {', '.join(hidden)}\n" if hidden else ""
    base = next((paths[id(ancestor)] for ancestor in ancestors if id(ancestor) in paths), None)
    shared = f"\n   More methods: see `~{base}`.\n" if base else ""
    return f".. autoclass:: {each.path}\n   :members:\n{left_out}{shared}"


def api_pages() -> dict[str, str]:
    """A page for each room that has public names, and one that lists them all."""
    names = public_names()
    paths = {id(each.thing): each.path for each in names}
    pages, groups = {}, []
    for page, members in groupby(names, key=lambda each: each.page):
        of_page = list(members)
        body = "\n".join(
            [f".. automodule:: {page}\n   :no-members:\n", *(directive(each, paths) for each in of_page)]
        )
        pages[page] = f"# {page}\n\n```{{eval-rst}}\n{body}```\n"
        rows = [[f"{{py:obj}}`~{each.path}`", each.said] for each in of_page]
        purpose = re.split(r"\.\s", inspect.getdoc(import_module(page)) or "")[0]
        package = of_page[0].path.rpartition(".")[0]
        head = f"## [{page}]({page}.md)\n\n{purpose}. Import from `{package}`.\n"
        groups.append(f"{head}\n{table(['name', 'what it is'], rows)}\n")
    tree = "\n".join(["```{toctree}", ":hidden:", "", *pages, "```\n"])
    return pages | {"index": "\n".join([API_HEAD, *groups, tree])}


def write_pages() -> None:
    """Write all pages into docs/environments/ and docs/api/."""
    environments, api = DOCS / "environments", DOCS / "api"
    for folder in (environments, api):
        folder.mkdir(exist_ok=True)
        for old in folder.iterdir():
            old.unlink()
    ours = [spec for spec in gym.registry.values() if spec.namespace == "motor_env"]
    for spec in ours:
        picture(spec, environments / f"{spec.id.split('/')[1]}.png")
    for name in FAMILIES:
        family = [spec for spec in ours if spec.id.startswith(f"motor_env/{name.removesuffix('-v0')}")]
        (environments / f"{name}.md").write_text(family_page(name, family), encoding="utf-8")
    for module, text in api_pages().items():
        (api / f"{module}.md").write_text(text, encoding="utf-8")
