# What a user imports from `motor_env`: listed here and nowhere else; loaded when first used.
from .common.errors import (
    InputError as InputError,
)
from .detection.plots import (
    plot_bank as plot_bank,
    plot_rules as plot_rules,
)
from .detection.rules import (
    Cusum as Cusum,
    Glr as Glr,
    ModelBank as ModelBank,
    MOfN as MOfN,
    Rule as Rule,
    ShiryaevRoberts as ShiryaevRoberts,
    Sprt as Sprt,
    TolerantFilter as TolerantFilter,
    WindowedNis as WindowedNis,
    in_a_row as in_a_row,
    nis_rule as nis_rule,
)
from .diagnosis.commission import (
    commission as commission,
)
from .diagnosis.diagnose import (
    Diagnosis as Diagnosis,
    diagnose as diagnose,
)
from .diagnosis.fleet.judging import (
    diagnose_fleet as diagnose_fleet,
)
from .diagnosis.fleet.learning import (
    learn_fleet as learn_fleet,
)
from .diagnosis.identification import (
    identify as identify,
)
from .diagnosis.prognosis.trend_report import (
    trend as trend,
)
from .diagnosis.readers.headers import (
    ColumnChoice as ColumnChoice,
)
from .diagnosis.readers.recording import (
    Recording as Recording,
    read_recording as read_recording,
)
from .diagnosis.streaming.watch import (
    watch as watch,
)
from .diagnosis.verdict.judgement import (
    Verdict as Verdict,
)
from .filters.adaptive import (
    adaptive_filter as adaptive_filter,
    joint_filter as joint_filter,
)
from .filters.batch import (
    FilterStream as FilterStream,
    filter_residuals as filter_residuals,
    run_filter as run_filter,
)
from .filters.consistency import (
    check_consistency as check_consistency,
)
from .filters.kalman import (
    KalmanFilter as KalmanFilter,
)
from .filters.smoothing import (
    smooth as smooth,
)
from .inference.posterior import (
    SeverityPrior as SeverityPrior,
    class_probabilities as class_probabilities,
    excess_over_limit as excess_over_limit,
    severity_posterior as severity_posterior,
)
from .motor.data_sheet import (
    Motor as Motor,
    load_motor as load_motor,
)
from .motor.faults import (
    Fault as Fault,
    FaultKind as FaultKind,
    register_fault_kind as register_fault_kind,
)
from .motor.model import (
    discretize as discretize,
)
from .motor.parameters import (
    PAPER_MOTOR as PAPER_MOTOR,
    Channel as Channel,
    MotorParameters as MotorParameters,
    SensorParameters as SensorParameters,
    SupplyParameters as SupplyParameters,
)
from .simulation.named_recipes import (
    load_recipe as load_recipe,
)
from .simulation.recipes import (
    Recipe as Recipe,
)
from .simulation.sampling import (
    draw as draw,
)
from .simulation.simulate import (
    Scenario as Scenario,
    Timing as Timing,
    Transients as Transients,
    simulate as simulate,
    simulate_states as simulate_states,
)

__version__: str
