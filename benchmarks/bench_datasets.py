"""Making labelled transients: against scipy's simulator, NumPy's generator and pyarrow's writer. One thread each.

The linear motor: `bench` recipe, 1000 samples, one channel, float32 with noise; the peers scipy.signal.dlsim (without
noise, one case at a time) and NumPy's SFC64 that draws the noise alone. To disk: `generate_dataset` against
pyarrow writing the same ready tables.
"""

import shutil
import tempfile
from pathlib import Path

import numpy as np
import pyarrow as pa
from run import Result, best_rate
from scipy.signal import dlsim

from motor_datasets import generate_arrays, generate_dataset, parquet
from motor_datasets.generate import make_plan
from motor_env.motor.faults import apply_faults
from motor_env.motor.model import discretize
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.named_recipes import RECIPES
from motor_env.simulation.sampling import draw, measure_draw

N_CASES = 1024
N_CASES_TO_DISK = 20_000
SEED = 1


def _dlsim_cases(count: int) -> list[FloatArray]:
    recipe = RECIPES["bench"]
    drawn = draw(recipe, SEED, np.arange(count))
    model = discretize(apply_faults(drawn.scenario.parameters, drawn.scenario.faults), recipe.timing.dt_s)
    answers = []
    for n in range(count):
        system = (
            model.transition[n],
            model.gain[n][:, :1],
            np.array([[1.0, 0.0]]),
            np.zeros((1, 1)),
            model.dt_s,
        )
        level = np.broadcast_to(drawn.scenario.supply.voltage_v, (count,))[n]
        answers.append(dlsim(system, np.full(recipe.timing.n_samples + 1, level))[1][1:, 0])
    return answers


def linear() -> list[Result]:
    """Samples a second, drawn, simulated and with noise, in memory."""
    recipe = RECIPES["bench"]
    shape = (N_CASES, 1, recipe.timing.n_samples)
    out = np.empty(shape, dtype=np.float32)
    cases = np.arange(N_CASES)
    generator = np.random.Generator(np.random.SFC64(SEED))
    noiseless = np.stack(_dlsim_cases(4))
    ours_noisy = measure_draw(draw(recipe, SEED, cases[:4]), recipe, SEED)[:, 0]
    assert np.abs(ours_noisy - noiseless).max() < 7.0 * recipe.sensor.current_noise_a
    ours = best_rate(lambda: measure_draw(draw(recipe, SEED, cases), recipe, SEED, out), out.size)
    peer = best_rate(lambda: _dlsim_cases(4), 4 * shape[-1], rounds=3)
    noise = best_rate(lambda: generator.standard_normal(shape, dtype=np.float32), out.size)
    name = f"linear motor with tolerances and noise, {N_CASES} x {shape[-1]} samples"
    return [
        Result(name, ours, peer, "scipy.signal.dlsim, no noise", bar=1000.0),
        Result(name, ours, noise, "NumPy SFC64 float32, noise alone", bar=2.0),
    ]


def _to_disk(folder: Path) -> None:
    generate_dataset(RECIPES["bench"], N_CASES_TO_DISK, SEED, folder)
    shutil.rmtree(folder)


def _write_ready(tables: list[pa.Table], folder: Path) -> None:
    folder.mkdir()
    for n, table in enumerate(tables):
        parquet.write_table(table, folder / f"{n}.parquet")
    shutil.rmtree(folder)


def to_disk() -> list[Result]:
    """Cases a second: made and written, against ready tables written by pyarrow with the same settings."""
    recipe = RECIPES["bench"]
    plan = make_plan(recipe, N_CASES_TO_DISK, SEED)
    tables = [
        parquet.to_table(generate_arrays(recipe, SEED, file.case_id(recipe, SEED))) for file in plan.files
    ]
    ours = peer = 0.0
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(5):  # in turns: a disk is not equally quick all the time
            ours = max(ours, best_rate(lambda: _to_disk(Path(folder) / "ours"), N_CASES_TO_DISK, rounds=2))
            peer = max(
                peer,
                best_rate(lambda: _write_ready(tables, Path(folder) / "peer"), N_CASES_TO_DISK, rounds=2),
            )
    return [Result("bench recipe to disk", ours, peer, "pyarrow, ready arrays", bar=0.6)]


def run() -> list[Result]:
    """All of them."""
    return [*linear(), *to_disk()]
