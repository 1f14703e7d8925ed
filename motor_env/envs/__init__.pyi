# What a user imports from `motor_env.envs`: listed here and nowhere else; loaded when first used.
from .adapters import (
    StableBaselinesVecEnv as StableBaselinesVecEnv,
)
from .drive.drive_env import (
    DriveEnv as DriveEnv,
    DriveVectorEnv as DriveVectorEnv,
)
from .drive.lqg import (
    Lqg as Lqg,
)
from .drive.options import (
    DriveOptions as DriveOptions,
)
from .maintain.maintain_env import (
    MaintainEnv as MaintainEnv,
    MaintainVectorEnv as MaintainVectorEnv,
)
from .maintain.options import (
    MaintainOptions as MaintainOptions,
)
from .maintain.replacement import (
    PlannedUpkeep as PlannedUpkeep,
    ThresholdReplacement as ThresholdReplacement,
)
from .monitor_and_probe import (
    MonitorEnv as MonitorEnv,
    MonitorVectorEnv as MonitorVectorEnv,
    ProbeContinuousEnv as ProbeContinuousEnv,
    ProbeContinuousVectorEnv as ProbeContinuousVectorEnv,
    ProbeEnv as ProbeEnv,
    ProbeOptions as ProbeOptions,
    ProbeVectorEnv as ProbeVectorEnv,
)
from .options import (
    MonitorOptions as MonitorOptions,
)
from .policies.evaluation import (
    parts_of as parts_of,
    returns_of as returns_of,
    run_episodes as run_episodes,
    score as score,
    sweep as sweep,
)
from .policies.fault_posterior import (
    ProbeBelief as ProbeBelief,
)
from .policies.posterior_policies import (
    BayesPolicy as BayesPolicy,
    BeliefPolicy as BeliefPolicy,
    EventTriggeredProbing as EventTriggeredProbing,
    ExpectedRewardTest as ExpectedRewardTest,
    PosteriorView as PosteriorView,
)
from .policies.residual_posterior import (
    ResidualPosterior as ResidualPosterior,
)
from .policies.rule_policies import (
    BankPolicy as BankPolicy,
    Never as Never,
    Policy as Policy,
    Random as Random,
    RulePolicy as RulePolicy,
    baseline_features as baseline_features,
)
