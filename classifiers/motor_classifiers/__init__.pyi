from .estimators.confirmation import (
    ThresholdConfirmationClassifier as ThresholdConfirmationClassifier,
)
from .estimators.features import (
    PhysicalFeatures as PhysicalFeatures,
    ResidualProjection as ResidualProjection,
    RuleStatistics as RuleStatistics,
)
from .estimators.methods import (
    METHODS as METHODS,
    make_method as make_method,
)
from .estimators.networks.epoch_classifier import (
    PerceptronClassifier as PerceptronClassifier,
    ResNetClassifier as ResNetClassifier,
    TorchClassifier as TorchClassifier,
)
from .estimators.networks.posterior_network import (
    PosteriorNetwork as PosteriorNetwork,
)
from .model_files.onnx_export import (
    export_onnx as export_onnx,
)
from .model_files.persistence import (
    load_model as load_model,
    save_model as save_model,
)
from .prediction import (
    Prediction as Prediction,
    predict as predict,
    predict_recording as predict_recording,
    predictions as predictions,
)
from .scoring.frozen_tasks import (
    load_task as load_task,
    score_answers as score_answers,
)
from .scoring.results import (
    evaluate_model as evaluate_model,
)
from .wrappers.conformal import (
    ConformalClassifier as ConformalClassifier,
    ConformalSets as ConformalSets,
)
from .wrappers.early import (
    EarlyClassifier as EarlyClassifier,
)
from .wrappers.outlier_detector import (
    OutsideDetector as OutsideDetector,
)
