"""A motor between its sisters and its own records: `motor-env commission --motor fleet.toml`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from motor_env.diagnosis.commission import fit_starts
from motor_env.diagnosis.learning import PRIOR_WEIGHT
from motor_env.diagnosis.motor_files import motor_of_windows, to_motor
from motor_env.diagnosis.running.windows import judge_of
from motor_env.diagnosis.views import Fitted
from motor_env.errors import InputError
from motor_env.fitting.recorded import at_terminals, from_recordings
from motor_env.fitting.starts.identified import Identified
from motor_env.fleet.fits import Reading
from motor_env.fleet.learning import about
from motor_env.fleet.population import at_least
from motor_env.motor.data_sheet import Motor
from motor_env.motor.healthy import Healthy
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.recording import Recording, recording_of
