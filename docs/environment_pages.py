"""Writes the pages of the environments, docs/environments: `make pages`. tests/test_pictures.py says when one is stale.

A page for each family of ids, from the docstring of its class, its options and its spaces; and one with all ids.
"""

import dataclasses
import inspect
import json
import re
import shutil
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib.image
import numpy as np
from gymnasium.envs.registration import EnvSpec
from matplotlib import pyplot as plt
from PIL import Image

import motor_env
from motor_env.envs import Lqg, MonitorOptions
from motor_env.envs.stepping import DECLARE_ABOVE

DOCS = Path(__file__).parent
RESULTS = DOCS.parent / "benchmarks" / "results" / "reference"
FAMILIES = ("Monitor-v0", "Probe-v0", "Drive-v0", "Maintain-v0")
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
LEVELS = (
    ("trivial", "always", "tab:red"),
    ("textbook", "textbook", "tab:orange"),
    ("best", "best known", "tab:green"),
)
"""Scores beside the learning curves: file, column of the table of reference scores, colour."""


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
    """Every number of an observation."""
    space, names = env.observation_space, env.observed
    texts = [FEATURES.get(name.split("_")[0], "") for name in names]
    rows = [
        [n, f"`{name}`", texts[n], f"{space.low[n]:.4g}", f"{space.high[n]:.4g}"]
        for n, name in enumerate(names)
    ]
    return table(["", "name", "what it is", "least", "most"], rows)


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


def curves(name: str, folder: Path) -> str:
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
    figure.savefig(folder / f"{name}-curve.png", dpi=110)
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


def variant(spec: EnvSpec, base: Any, folder: Path) -> list[str]:
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
    return [*parts, curves(name, folder)]


def family_page(name: str, specs: list[EnvSpec], folder: Path) -> str:
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
        *(part for spec in others for part in variant(spec, env, folder)),
        "## Scores",
        "All ids beside each other, and what the columns mean: [reference scores](../reference-scores.md).",
        score_rows([spec.id.split("/")[1] for spec in [first, *others]]),
        curves(name, folder),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


WIDTH_PX = 240
TRIALS, SEED = 64, 1
HEAD = f"""# All ids at a glance

In the order in which an agent should try them. *Steps at random* is the mean length of {TRIALS} episodes of random
actions: it shows how soon a careless agent ends one. What scores where: [reference scores](../reference-scores.md).

| id | | an episode, at most | steps at random | actions | observed | `reward_threshold` |
|---|---|---|---|---|---|---|
"""


def horizon(env: Any) -> tuple[int, str]:
    """The largest number of steps, and what a step is in time."""
    options = env.options
    if hasattr(options, "days"):
        return int(options.days), "a day"
    if hasattr(options, "steps_per_decision"):
        step_s = options.period_s * options.steps_per_decision
        return options.n_steps // options.steps_per_decision, f"{1000 * step_s:g} ms"
    return options.n_steps, f"{1000 * options.dt_s * options.samples_per_step:g} ms"


def random_length(env: Any) -> float:
    """Mean number of steps of an episode of random actions."""
    env.reset(seed=SEED)
    env.action_space.seed(SEED)
    steps = 0
    for _ in range(TRIALS):
        over = False
        while not over:
            over = env.step(env.action_space.sample())[2]
            steps += 1
        env.reset()
    return steps / TRIALS


def row(spec: EnvSpec, folder: Path) -> str:
    """An id in the table of all; its small picture goes beside the screen."""
    env: Any = gym.make(spec.id).unwrapped
    name, (most, step) = spec.id.split("/")[1], horizon(env)
    with Image.open(folder / f"{name}.png") as screen:
        small = screen.convert("RGB").resize((WIDTH_PX, WIDTH_PX * screen.height // screen.width))
    small.save(folder / f"{name}-small.png")
    space = env.action_space
    family = next(each for each in FAMILIES if name.startswith(each.removesuffix("-v0")))
    page = f"{family}.md" if name == family else f"{family}.md#{name.lower()}"
    cells = [
        f"[{name}]({page})",
        f"[![Screen of {name}]({name}-small.png)]({page})",
        f"{most:,} steps of {step}",
        f"{random_length(env):.0f}",
        f"{space.n} to choose from" if hasattr(space, "n") else f"{space.shape[0]} numbers",
        f"{env.observation_space.shape[0]} numbers",
        f"{spec.reward_threshold:+.3f}",
    ]
    return "| " + " | ".join(cells) + " |\n"


def write_pages(folder: Path) -> None:
    """Write all pages and their pictures into an empty folder."""
    ours = [spec for spec in gym.registry.values() if spec.namespace == "motor_env"]
    for spec in ours:
        picture(spec, folder / f"{spec.id.split('/')[1]}.png")
    for name in FAMILIES:
        family = [spec for spec in ours if spec.id.startswith(f"motor_env/{name.removesuffix('-v0')}")]
        (folder / f"{name}.md").write_text(family_page(name, family, folder), encoding="utf-8")
    (folder / "all.md").write_text(HEAD + "".join(row(spec, folder) for spec in ours), encoding="utf-8")
    for path in folder.glob("*.png"):
        with Image.open(path) as drawn:
            few = drawn.convert("RGB").quantize(64)
        few.save(path, optimize=True)


if __name__ == "__main__":
    environments = DOCS / "environments"
    shutil.rmtree(environments, ignore_errors=True)
    environments.mkdir()
    write_pages(environments)
