"""The amortised posterior: a network trained on a recipe's stream approximates the exact one.

Cross-entropy makes it tend to the posterior probabilities (Bishop 2006, ch. 5.2; Papamakarios & Murray 2016). A second
network gives the density of the severity for each fault kind.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import KW_ONLY, asdict, dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.utils.validation import check_is_fitted
from torch import nn

from motor_classifiers.estimators.cases import (
    Arrays,
    State,
    check_classes,
    flat_cases,
    labelled_cases,
    module_arrays,
    part_of,
    plain_parameters,
    values_of_start,
)
from motor_classifiers.estimators.networks.epoch_classifier import LogitClassifier, logits_in_parts
from motor_classifiers.estimators.networks.posterior import Posterior, total_cases
from motor_classifiers.estimators.networks.severity_density import (
    PARAMETERS,
    severity_loss,
    severity_priors,
    severity_recipe,
    summary,
)
from motor_classifiers.estimators.networks.signal_space import SignalSpace, fresh_cases
from motor_classifiers.estimators.networks.training import Batch, Loss, OnStep, one_thread, seed_of
from motor_classifiers.estimators.reference_starts import split_starts
from motor_datasets.arrays import Dataset
from motor_env.common.arrays import number, numbers, whole
from motor_env.inference.posterior import SeverityPrior
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import Recipe

_OWN_SEEDS = 2**63  # the streams' seeds lie above: no data set is drawn with one of those by accident
_SEEDS_OF_ONE = 4  # two networks, two sizes of batches
_LEVEL_CASES = 4096
_CASES_WEIGHT_DECAY = 0.1
_CHUNK = 4096  # cases judged at once

UNKNOWN_NOISE = (0.15, 5.0)
"""Range of the noise over the recipe's that a network for a motor file estimates from the start."""

Progress = Callable[[int, int], object]
"""Called with the starts seen and all starts."""


class SeverityEstimate(NamedTuple):
    """Severity of each case, given its fault kind.

    Attributes:
        kind: fault kind of each case, shape (n_cases,).
        mean: posterior mean, shape (n_cases,).
        low: lower bound of the interval between equal tails, shape (n_cases,).
        high: its upper bound.
    """

    kind: NDArray[np.str_]
    mean: FloatArray
    low: FloatArray
    high: FloatArray


@dataclass(eq=False, repr=False)
class PosteriorNetwork(LogitClassifier):
    """The amortised posterior of a recipe as a scikit-learn classifier.

    With a recipe it learns from fresh cases that the recipe draws, classes and severities: `from_recipe(recipe)`, and
    `fit`, which only checks the cases that it is given. Without one `fit` learns the classes alone, from these cases.

    Args:
        recipe: the motor, its nuisances, faults and sensor; without one, `fit` learns from its cases.
        n_components: directions of the signal that the network sees; None for all along which the starts of the recipe
            differ by a tenth of the noise or more, at least 10 and at most 32.
        steps: batches seen by each of the two networks.
        batch_size: cases of a batch; the last ones are four times as large.
        noise_range: bounds of the factor on the recipe's noise, if the network shall estimate it; None for the
            recipe's noise.
        with_severity: whether to train the network of severities.
        n_references: healthy starts of the same motor with each start (`reference_starts.referenced_starts`).

    Attributes:
        classes_: labels: all classes of the recipe, or those of the given cases.
        posterior_: torch module, from flattened cases to the logits of `classes_`.
        severity_: torch module, from flattened cases to the densities of the severities; None without a recipe, or
            where none was asked for.
        severity_priors_: kinds and ranges of the severities, in the order of the module; empty where there is none.
        n_drawn_: starts drawn for the training; not without a recipe.
    """

    recipe: Recipe | None = None
    n_components: int | None = None
    _: KW_ONLY
    n_hidden: int = 96
    n_layers: int = 2
    steps: int = 2500
    batch_size: int = 512
    learning_rate: float = 0.01
    noise_range: tuple[float, float] | None = None
    with_severity: bool = True
    n_references: int = 0
    random_state: int | np.random.RandomState | None = None

    @classmethod
    def from_recipe(
        cls, recipe: Recipe, *, on_step: Progress = lambda starts, total: None, **parameters: Any
    ) -> Self:
        """Train a network on the recipe's stream of cases.

        Args:
            recipe: the motor, its nuisances, faults and sensor.
            on_step: called after each step, with the starts seen and all starts.
            parameters: of the constructor.

        Raises:
            ValueError: fewer than two classes, or a bad noise range.
        """
        return cls(recipe, **parameters).fit_stream(on_step)

    def fit(self, X: Any, y: Any) -> Self:
        """Train on the stream of the recipe; without one, on the given cases, in random batches.

        Raises:
            ValueError: fewer than two classes, labels unknown to the recipe, or shapes that do not fit.
        """
        self._check_training()
        flat, labels = labelled_cases(self, X, y)
        if self.recipe is not None:
            self.recipe.require_step()
            starts = split_starts(flat, self.recipe).shape[1]
            wanted = 1 + self.n_references
            require(starts == wanted, f"a case must be {wanted} starts, got {starts}")
            check_classes(self.recipe, self.classes_)
            return self.fit_stream()
        space = SignalSpace.from_cases(flat, self.n_components)
        posterior = Posterior(space, n_hidden=self.n_hidden, n_layers=self.n_layers, n_out=len(self.classes_))
        generator = torch.Generator().manual_seed(seed_of(self.random_state))
        targets = torch.from_numpy(labels)

        def batches(part: int, batch_size: int) -> Iterator[Batch]:
            while True:
                chosen = torch.randint(len(targets), (batch_size,), generator=generator)
                yield inputs[chosen], targets[chosen]

        with one_thread():
            cases = torch.from_numpy(np.array(flat))
            space.observe_level(space(cases))
            inputs = space(cases)
            posterior.learn(
                batches,
                nn.functional.cross_entropy,
                generator,
                **self._training(),
                weight_decay=_CASES_WEIGHT_DECAY,
            )
        self.posterior_: Posterior = posterior
        self.severity_: Posterior | None = None
        self.severity_priors_: tuple[SeverityPrior, ...] = ()
        return self

    def fit_stream(self, on_step: Progress = lambda starts, total: None) -> Self:
        """Train on fresh cases of the recipe.

        Args:
            on_step: called after each step, with the starts seen and all starts.

        Raises:
            ValueError: no recipe, fewer than two classes, or a bad noise range.
        """
        self._check_training()
        recipe = self._stream_recipe()
        self.n_features_in_ = (1 + self.n_references) * values_of_start(recipe)
        self.classes_ = np.array(sorted(recipe.class_names))
        self.severity_priors_ = severity_priors(recipe) if self.with_severity else ()
        ranks = torch.from_numpy(np.searchsorted(self.classes_, np.array(recipe.class_names)))
        tops = torch.tensor([prior.largest for prior in self.severity_priors_])

        def classes(batch: Dataset) -> torch.Tensor:
            return ranks[torch.from_numpy(batch.class_index)]

        def severities(batch: Dataset) -> torch.Tensor:
            kinds = torch.from_numpy(batch.class_index)
            return torch.stack([kinds.float(), torch.from_numpy(batch.severity).float() / tops[kinds]], dim=1)

        seen = 0
        self.n_drawn_ = (1 + self.with_severity) * total_cases(self.batch_size, self.steps)
        seed = _OWN_SEEDS + _SEEDS_OF_ONE * seed_of(self.random_state)

        def after_step(count: int) -> None:
            nonlocal seen
            seen += count
            on_step(seen, self.n_drawn_)

        with one_thread():
            self.posterior_ = self._train_posterior(
                recipe, classes, nn.functional.cross_entropy, n_out=len(ranks), seed=seed, on_step=after_step
            )
            self.severity_ = None
            if self.with_severity:
                ranges = severity_recipe(recipe, with_healthy=self.n_references > 0)
                n_out = PARAMETERS * len(tops)
                self.severity_ = self._train_posterior(
                    ranges, severities, severity_loss, n_out=n_out, seed=seed + 2, on_step=after_step
                )
        return self

    def _train_posterior(
        self,
        recipe: Recipe,
        target: Callable[[Dataset], torch.Tensor],
        loss: Loss,
        *,
        n_out: int,
        seed: int,
        on_step: OnStep,
    ) -> Posterior:
        low, high = self._checked_noise()
        space = self._space(recipe)
        posterior = Posterior(space, n_hidden=self.n_hidden, n_layers=self.n_layers, n_out=n_out).float()

        def fresh(part: int, batch_size: int) -> Iterator[Batch]:
            stream = fresh_cases(
                posterior.space,
                recipe,
                seed + part,
                batch_size,
                most_noise=high / low,
                n_references=self.n_references,
            )
            return ((inputs, target(batch)) for inputs, batch in stream)

        posterior.space.observe_level(next(fresh(0, _LEVEL_CASES))[0])
        generator = torch.Generator().manual_seed(seed)
        posterior.learn(fresh, loss, generator, **self._training(), on_step=on_step)
        return posterior.double()

    def _stream_recipe(self) -> Recipe:
        """Return the recipe to train on: one start a motor, at the least noise."""
        if self.recipe is None:
            raise ValueError("fit_stream needs a recipe, got None")
        # Commissioning starts are known to be healthy and never judged; a motor of its own for each start teaches more.
        judged = replace(self.recipe, starts_per_motor=1, healthy_starts=0, shifts=())
        recipe = replace(judged, sensor=judged.sensor.with_noise(self._checked_noise()[0]))
        require(self.n_references >= 0, f"n_references must be >= 0, got {self.n_references}")
        require(
            self.n_references == 0 or not _tells_noise(recipe),
            "n_references must be 0 for a recipe with a noise fault: one level is read off all starts",
        )
        require(len(recipe.classes) >= 2, f"recipe {recipe.name} must have two classes or more, got one")
        return recipe

    def _space(self, recipe: Recipe) -> SignalSpace:
        """Return coordinates of the recipe's cases, with the noise level where it is unknown."""
        low, high = self._checked_noise()
        sees_noise = high > low or _tells_noise(recipe)
        return SignalSpace.from_recipe(
            recipe, self.n_components, sees_noise=sees_noise, n_references=self.n_references
        )

    def _training(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("steps", "batch_size", "learning_rate")}

    def predict_severity(self, X: Any, kind: str | None = None, coverage: float = 0.90) -> SeverityEstimate:
        """Estimate the severity of the fault, with an interval.

        Args:
            X: shape (n_cases, n_channels, n_timepoints), or flattened.
            kind: fault kind; by default the most probable one of each case, even if healthy is more probable.
            coverage: of the interval.

        Raises:
            ValueError: not trained on a recipe's stream, an unknown kind, or a coverage outside (0, 1).
        """
        check_is_fitted(self)
        number("coverage", coverage, above=0.0, below=1.0)
        flat = flat_cases(self, X, reset=False)
        if self.severity_ is None:
            raise ValueError(
                "a severity needs a network trained on a recipe's stream and with_severity, this one has none"
            )
        names = [str(prior.kind) for prior in self.severity_priors_]
        require(kind is None or kind in names, f"kind must be one of {', '.join(names)}, got {kind!r}")
        column = self._probable_kind(flat, names) if kind is None else np.full(len(flat), names.index(kind))
        densities = logits_in_parts(self.severity_, flat, _CHUNK).reshape(len(flat), len(names), -1)
        own = torch.from_numpy(densities[np.arange(len(flat)), column])
        tail = 0.5 * (1.0 - coverage)
        with one_thread(), torch.inference_mode():
            parts = [summary(part, tail) for part in torch.split(own, _CHUNK)]
        tops = np.array([prior.largest for prior in self.severity_priors_])[column]
        mean, low, high = tops * torch.cat(parts, dim=1).numpy()
        return SeverityEstimate(np.array(names)[column], mean, low, high)

    def _probable_kind(self, flat: FloatArray, names: list[str]) -> NDArray[np.int64]:
        probabilities = self.predict_proba(flat)
        by_name = {c.name: c for c in self.recipe.classes}  # type: ignore[union-attr]  # there is one where severities are
        kinds = [[str(part.kind) for part in by_name[label].parts] for label in self.classes_.tolist()]
        shares = probabilities @ np.array([[present.count(name) for name in names] for present in kinds])
        column: NDArray[np.int64] = shares.argmax(axis=1)
        return column

    def _logits(self, X: Any) -> FloatArray:
        check_is_fitted(self)
        return logits_in_parts(self.posterior_, flat_cases(self, X, reset=False), _CHUNK)

    def to_state(self) -> State:
        """Return the fitted network as arrays and values, in single precision if that is lossless."""
        modules = {"classes": self.posterior_}
        if self.severity_ is not None:
            modules["severity"] = self.severity_
        values = {
            "parameters": plain_parameters(self),
            "severities": [asdict(prior) for prior in self.severity_priors_],
            "sees_noise": {part: module.space.sees_noise for part, module in modules.items()},
        }
        arrays: Arrays = {}
        for part, module in modules.items():
            arrays |= {name: _compact(numbers) for name, numbers in module_arrays(module, part).items()}
        return State(arrays, values)

    @classmethod
    def from_state(cls, state: State, recipe: Recipe) -> Self:
        """Restore the fitted network.

        Raises:
            ValueError, KeyError, TypeError, RuntimeError: values or arrays of a wrong type or shape.
        """
        parameters = dict(state.values["parameters"])
        if parameters.get("noise_range") is not None:
            low, high = map(float, parameters["noise_range"])
            parameters["noise_range"] = (low, high)
        references = parameters.get("n_references", 0)
        require(type(references) is int and references >= 0, f"n_references must be >= 0, got {references!r}")
        model = cls(recipe, **parameters)
        model._checked_noise()
        model.classes_ = np.array(state.values["classes"])
        model.n_features_in_ = (1 + references) * values_of_start(recipe)
        model.severity_priors_ = tuple(SeverityPrior(**prior) for prior in state.values["severities"])
        n_out = {"classes": len(model.classes_)}
        if model.severity_priors_:
            n_out["severity"] = PARAMETERS * len(model.severity_priors_)
        parts = {name.split(".")[0] for name in state.arrays}
        require(parts <= set(n_out), "it holds arrays of no part")
        modules = {
            part: Posterior.from_arrays(
                part_of(state.arrays, part),
                sees_noise=state.values["sees_noise"][part],
                n_features=model.n_features_in_,
                sizes=(model.n_hidden, model.n_layers, size),
            )
            for part, size in n_out.items()
        }
        model.posterior_, model.severity_ = modules["classes"], modules.get("severity")
        return model

    def _check_training(self) -> None:
        whole("steps", self.steps, 1)
        whole("batch_size", self.batch_size, 1)
        number("learning_rate", self.learning_rate, above=0.0)

    def _checked_noise(self) -> tuple[float, float]:
        if self.noise_range is None:
            return 1.0, 1.0
        low, high = numbers("noise_range", self.noise_range, (2,)).tolist()
        require(0.0 < low < high < np.inf, f"noise_range must be 0 < low < high, got {low:g} to {high:g}")
        tells = self.recipe is not None and _tells_noise(self.recipe)
        require(not tells, "noise_range must be None for a recipe with a noise fault: they look the same")
        return low, high


def _compact(values: NDArray[np.float64]) -> NDArray[Any]:
    single = values.astype(np.float32)
    return single if np.array_equal(single, values) else values


def _tells_noise(recipe: Recipe) -> bool:
    return any(kind.changes_noise for kind in recipe.kinds)
