"""Commands that need no recording: the paper, the lab, the examples, and compiling ahead."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Literal

from motor_env.cli.options import show
from motor_env.common import console
from motor_env.common.errors import require_extra


def reproduce(*, out: Path, json_: bool = False) -> int:
    """Write a page with the source paper's figures, its numbers beside ours, and its errors.

    Example: motor-env reproduce --out out/paper

    Args:
        out: Folder for index.html, paper.md, reproduce.json and images/. A folder with other files is refused.
        json_: Print the content of reproduce.json.
    """
    with console.working("computing the paper's numbers") as update:
        from motor_env.apps import reproduce as paper

        result = paper.reproduce(out, progress=lambda figure: update(description=f"drawing {figure.name}"))
    counts = f"{len(result['figures'])} figures and {len(result['numbers'])} numbers"
    show(json_, lambda: result, lambda: f"{counts}: {out / 'index.html'}")
    return 0


def lab(*, port: console.Whole = 0, no_browser: bool = False) -> int:
    """Open a page in the browser: set faults and noise by sliders, see residual, rule and verdict, drop a recording.

    Example: motor-env lab

    It runs on this machine only (127.0.0.1), needs no network, and ends with Ctrl-C.

    Args:
        port: Port of the page; 0 takes a free one.
        no_browser: Do not open the page.
    """
    import webbrowser

    from motor_env.apps import lab_server

    with lab_server.make_server(port) as server:
        print(f"{lab_server.address(server)}  (Ctrl-C ends it)", flush=True)
        if not no_browser:
            webbrowser.open(lab_server.address(server))
        server.serve_forever()
    return 0


def examples(folder: Path = Path("examples")) -> int:
    """Write the examples of the documentation into a folder: a capture, a motor file, and scripts.

    Example: motor-env examples

    Args:
        folder: Folder to write to; existing files are kept.
    """
    from motor_env.common.files import write_examples

    for path in write_examples(folder):
        print(path)
    return 0


def warm_up() -> int:
    """Compile the commands and environments for this machine now, so that no later call waits for it.

    Example: motor-env warm-up
    """
    from motor_env.apps import warming

    print("compiling: a minute or two", file=sys.stderr, flush=True)
    seconds = warming.warm_up(said=lambda part, took: print(f"{took:6.1f} s  {part}", flush=True))
    print(f"{sum(seconds.values()):6.1f} s  all; nothing is compiled from now on")
    return 0


def offline(
    task: str,
    *,
    out: Path,
    behaviour: Literal["random", "rule", "best", "mixed"] = "mixed",
    episodes: console.Whole = 300,
    seed: console.Whole = 0,
) -> int:
    """Record a known policy in an environment as a Minari data set, for offline reinforcement learning.

    Example: motor-env offline Monitor-v0 --behaviour mixed --out out/minari

    Args:
        task: Environment, such as Monitor-v0, Probe-v0 or Maintain-v0.
        out: Folder of the data sets, Minari's MINARI_DATASETS_PATH.
        behaviour: Policy: random, rule (a textbook rule), best (the best known), or mixed (a third of each).
        episodes: Number of episodes.
        seed: Random seed of the episodes.
    """
    require_extra("minari", "minari")  # before anything is compiled
    from motor_env.envs.offline_data import Behaviour, record

    with console.working("recording episodes"):
        name = record(task, Behaviour(behaviour), out, episodes=episodes, seed=seed)
    print(f"written: {name} in {out}; MINARI_DATASETS_PATH={out} lets minari find it")
    return 0
