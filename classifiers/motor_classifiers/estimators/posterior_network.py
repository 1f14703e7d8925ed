"""An amortised posterior: a small network that has seen millions of fresh starts says what the exact one would.

Trained by cross-entropy on an endless stream of the recipe's own cases, a network tends to the posterior
probabilities (Bishop 2006, ch. 5.2; "neural posterior estimation": Papamakarios & Murray 2016); its inputs are the few
coordinates that hold what a transient can tell. A second one gives the density of the severity for each fault kind.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.utils.validation import check_is_fitted
from torch import nn

from motor_classifiers.estimators import severity_density
from motor_classifiers.estimators.cases import flat_cases, labelled_cases, severities_of
from motor_classifiers.estimators.perceptron import LogitClassifier, one_thread, seed_of
from motor_classifiers.estimators.reference_starts import split_starts
from motor_classifiers.estimators.signal_space import SignalSpace
from motor_classifiers.estimators.stream_training import (
    Batch,
    Loss,
    Posterior,
    fresh_cases,
    growing,
    total_cases,
    train_on_batches,
)
from motor_datasets.arrays import Dataset
from motor_env.inference.severity import SeverityPrior
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import FaultClass, Recipe

_OWN_SEEDS = 2**63  # the streams' seeds lie above: no data set is drawn with one of those by accident
_SEEDS_OF_ONE = 4  # two networks, two sizes of batches
_LEVEL_CASES = 4096
_CASES_WEIGHT_DECAY = 0.1
_CHUNK = 4096  # cases judged at once
_ALWAYS = (FaultKind.BEARING, FaultKind.WINDING_CONTACT, FaultKind.WINDING_SHORT)
_LEAST_RANGE, _BEYOND, _LARGEST_LOSS = 0.30, 1.2, 0.95

OnStep = Callable[[int, int], object]


class SeverityEstimate(NamedTuple):
    """How large the fault of each case is, given that it is of this kind.

    Attributes:
        kind: fault kind of each case, shape (n_cases,).
        mean: posterior mean, shape (n_cases,): the estimate with the smallest mean squared error.
        low: lower bound of the interval between equal tails, shape (n_cases,).
        high: its upper bound.
    """

    kind: NDArray[np.str_]
    mean: FloatArray
    low: FloatArray
    high: FloatArray


def severity_priors(recipe: Recipe) -> tuple[SeverityPrior, ...]:
    """Ranges of the severities that are told: every kind of the motor, and noise where it is a class.

    From 0 to 30 %, or to 1.2 times the largest severity among the recipe's classes.
    """
    largest: dict[FaultKind, float] = dict.fromkeys(_ALWAYS, _LEAST_RANGE)
    for part in (part for c in recipe.classes for part in c.parts):
        if part.kind is not None:
            top = _BEYOND * part.largest_severity
            largest[part.kind] = max(largest.get(part.kind, 0.0), top)
    return tuple(
        SeverityPrior(kind, 0.0, min(to, _LARGEST_LOSS) if kind.loses else to) for kind, to in largest.items()
    )


def severity_recipe(recipe: Recipe, *, with_healthy: bool = False) -> Recipe:
    """The recipe with one class a kind, its severity uniform over the range of `severity_priors`.

    Args:
        recipe: the motor, its nuisances, faults and sensor.
        with_healthy: whether a healthy class, which is never drawn, stands behind them: reference starts need one.
    """
    classes = [FaultClass(p.kind, 0.0, severity_to=p.largest) for p in severity_priors(recipe)]
    if with_healthy:
        classes.append(FaultClass(weight=0.0))
    return replace(recipe, classes=tuple(classes), healthy_starts=0, shifts=())


class PosteriorNetwork(LogitClassifier):
    """The amortised posterior of a recipe behind scikit-learn's interface.

    With a recipe it learns from fresh cases that the recipe draws, not from those given to `fit`, which are only
    checked; `fit_stream` needs none. Without a recipe it learns from the given cases, and tells no severity.

    Args:
        recipe: the motor, its nuisances, faults and sensor.
        n_components: directions of the signal that the network sees; None for all along which the starts of the recipe
            differ by a quarter of the noise or more, at least 10 and at most 32.
        n_hidden: width of a hidden layer.
        n_layers: hidden layers.
        steps: batches seen by each of the two networks.
        batch_size: cases of a batch; the last ones are four times as large.
        learning_rate: highest rate; it falls to 0 along a cosine.
        noise_range: smallest and largest factor on the recipe's noise, when the noise's level is not known and the
            network shall read it off the transient; None for the recipe's own.
        with_severity: whether the second network, that of the severities, is trained too.
        n_references: healthy starts of the same motor that come with each start (`reference.referenced_starts`).
        random_state: seed, generator or None, as in scikit-learn.

    Attributes:
        classes_: labels: all classes of the recipe, or those of the given cases.
        posterior_: torch module, from flattened cases to the logits of `classes_`.
        severity_: torch module, from flattened cases to the densities of the severities; None without a recipe, or
            where none was asked for.
        severity_priors_: kinds and ranges of the severities, in the order of the module; empty where there is none.
        n_drawn_: starts drawn for the training.
        n_features_in_: n_channels * n_timepoints.
    """

    def __init__(
        self,
        recipe: Recipe | None = None,
        n_components: int | None = None,
        n_hidden: int = 96,
        n_layers: int = 2,
        steps: int = 2500,
        batch_size: int = 512,
        learning_rate: float = 0.01,
        noise_range: tuple[float, float] | None = None,
        with_severity: bool = True,
        n_references: int = 0,
        random_state: int | np.random.RandomState | None = None,
    ) -> None:
        self.recipe = recipe
        self.n_components = n_components
        self.n_hidden = n_hidden
        self.n_layers = n_layers
        self.steps = steps
        self.batch_size = batch_size
        self.learning_rate = learning_rate
        self.noise_range = noise_range
        self.with_severity = with_severity
        self.n_references = n_references
        self.random_state = random_state

    def fit(self, X: Any, y: Any) -> Self:
        """Train: on the recipe's stream where there is a recipe, else on the given cases.

        Raises:
            ValueError: fewer than two classes, labels that the recipe does not know, or shapes that do not fit.
        """
        flat, labels = labelled_cases(self, X, y)
        if self.recipe is None:
            return self._fit_cases(flat, labels)
        starts = split_starts(flat, self.recipe).shape[1]
        require(
            starts == 1 + self.n_references, f"a case must be {1 + self.n_references} starts, got {starts}"
        )
        severities_of(self.recipe, self.classes_)
        return self.fit_stream()

    def fit_stream(self, on_step: OnStep = lambda done, total: None) -> Self:
        """Train on fresh cases of the recipe; nothing else is needed.

        Args:
            on_step: called with the steps done and all steps, after each.

        Raises:
            ValueError: no recipe, a recipe with fewer than two classes, or a noise range that does not fit.
        """
        if self.recipe is None:
            raise ValueError("fit_stream needs a recipe, got None")
        # Commissioning starts are known to be healthy and never judged; a motor of its own for each start teaches more.
        judged = replace(self.recipe, starts_per_motor=1, healthy_starts=0, shifts=())
        recipe = _with_noise(judged, self._checked_noise()[0])
        require(self.n_references >= 0, f"n_references must be >= 0, got {self.n_references}")
        alone = self.n_references == 0 or not _tells_noise(recipe)
        require(
            alone, "n_references must be 0 for a recipe with a noise fault: one level is read off all starts"
        )
        require(len(recipe.classes) >= 2, f"recipe {recipe.name} must have two classes or more, got one")
        self.n_features_in_ = (1 + self.n_references) * len(recipe.sensor.channels) * recipe.timing.n_samples
        self.classes_ = np.array(sorted(recipe.class_names))
        self.severity_priors_ = severity_priors(recipe) if self.with_severity else ()
        ranks = torch.from_numpy(np.searchsorted(self.classes_, np.array(recipe.class_names)))
        tops = torch.tensor([prior.largest for prior in self.severity_priors_])
        seed = _OWN_SEEDS + _SEEDS_OF_ONE * seed_of(self.random_state)

        def classes(batch: Dataset) -> torch.Tensor:
            return ranks[torch.from_numpy(batch.class_index)]

        def severities(batch: Dataset) -> torch.Tensor:
            kinds = torch.from_numpy(batch.class_index)
            return torch.stack([kinds.float(), torch.from_numpy(batch.severity).float() / tops[kinds]], dim=1)

        networks = 1 + self.with_severity
        self.n_drawn_ = networks * total_cases(self.batch_size, self.steps)
        self.severity_: Posterior | None = None
        with one_thread():
            self.posterior_ = self._learn(
                recipe,
                seed,
                classes,
                nn.functional.cross_entropy,
                len(ranks),
                lambda n: on_step(n, networks * self.steps),
            )
            if self.with_severity:
                self.severity_ = self._learn(
                    severity_recipe(recipe, with_healthy=self.n_references > 0),
                    seed + 2,
                    severities,
                    _severity_loss,
                    severity_density.PARAMETERS * len(tops),
                    lambda n: on_step(self.steps + n, networks * self.steps),
                )
        return self

    def _learn(
        self,
        recipe: Recipe,
        seed: int,
        target: Callable[[Dataset], torch.Tensor],
        loss: Loss,
        n_out: int,
        on_step: Callable[[int], object],
    ) -> Posterior:
        """A network that has seen the recipe's stream, in double precision."""
        low, high = self._checked_noise()
        sees_noise = high > low or _tells_noise(recipe)
        space = SignalSpace.of_recipe(
            recipe, self.n_components, sees_noise=sees_noise, n_references=self.n_references
        )
        posterior = Posterior(space, self.n_hidden, self.n_layers, n_out).float()
        space = posterior.space

        def fresh(part: int, batch_size: int) -> Iterator[tuple[torch.Tensor, Dataset]]:
            return fresh_cases(space, recipe, seed + part, batch_size, high / low, self.n_references)

        def batches(part: int, batch_size: int) -> Iterator[Batch]:
            for inputs, batch in fresh(part, batch_size):
                yield inputs, target(batch)

        space.observe_level(next(fresh(0, _LEVEL_CASES))[0])

        train_on_batches(
            posterior.network,
            growing(batches, self.batch_size, self.steps),
            loss,
            torch.Generator().manual_seed(seed),
            steps=self.steps,
            learning_rate=self.learning_rate,
            on_step=on_step,
        )
        return posterior.double()

    def _fit_cases(self, flat: FloatArray, labels: NDArray[np.int64]) -> Self:
        """Train on given cases, in random batches."""
        space = SignalSpace.of_cases(flat, self.n_components)
        posterior = Posterior(space, self.n_hidden, self.n_layers, len(self.classes_))
        generator = torch.Generator().manual_seed(seed_of(self.random_state))
        targets = torch.from_numpy(labels)

        def batches(part: int, batch_size: int) -> Iterator[Batch]:
            while True:
                chosen = torch.randint(len(targets), (batch_size,), generator=generator)
                yield inputs[chosen], targets[chosen]

        with one_thread():
            inputs = space(_tensor(flat))
            train_on_batches(
                posterior.network,
                growing(batches, self.batch_size, self.steps),
                nn.functional.cross_entropy,
                generator,
                steps=self.steps,
                learning_rate=self.learning_rate,
                weight_decay=_CASES_WEIGHT_DECAY,
            )
        self.posterior_, self.severity_, self.severity_priors_ = posterior, None, ()
        return self

    def predict_severity(self, X: Any, kind: str | None = None, coverage: float = 0.90) -> SeverityEstimate:
        """How large the fault is, with an interval.

        Args:
            X: shape (n_cases, n_channels, n_timepoints), or flattened.
            kind: fault kind; without one, the most probable kind of each case, also where healthy is more probable.
            coverage: of the interval.

        Raises:
            ValueError: trained without a recipe, a kind that the network does not know, or a coverage outside (0, 1).
        """
        check_is_fitted(self)
        require(0.0 < coverage < 1.0, f"coverage must be in (0, 1), got {coverage:g}")
        flat = flat_cases(self, X, reset=False)
        if self.severity_ is None:
            raise ValueError(
                "a severity needs a network trained with a recipe and with_severity, this one has none"
            )
        names = [str(prior.kind) for prior in self.severity_priors_]
        require(kind is None or kind in names, f"kind must be one of {', '.join(names)}, got {kind!r}")
        column = self._probable_kind(flat, names) if kind is None else np.full(len(flat), names.index(kind))
        tail = 0.5 * (1.0 - coverage)
        parts = []
        for begin in range(0, len(flat), _CHUNK):
            chosen = slice(begin, begin + _CHUNK)
            with one_thread(), torch.inference_mode():
                outputs = self.severity_(_tensor(flat[chosen]))
                densities = outputs.reshape(len(outputs), len(names), -1)
                own = densities[torch.arange(len(densities)), torch.from_numpy(column[chosen])]
                share = severity_density.weights(own)
                bounds = (severity_density.quantile(share, p) for p in (tail, 1.0 - tail))
                parts.append(torch.stack([severity_density.mean(share), *bounds]).numpy())
        tops = np.array([prior.largest for prior in self.severity_priors_])[column]
        mean, low, high = tops * np.concatenate(parts, axis=1)
        return SeverityEstimate(np.array(names)[column], mean, low, high)

    def _probable_kind(self, flat: FloatArray, names: list[str]) -> NDArray[np.int64]:
        """Column of the most probable fault kind of each case."""
        probabilities = self.predict_proba(flat)
        by_name = {c.name: c for c in self.recipe.classes}  # type: ignore[union-attr]  # there is one where severities are
        share = np.zeros((len(flat), len(names)))
        for label, probability in zip(self.classes_.tolist(), probabilities.T, strict=True):
            for part in by_name[label].parts:
                if part.kind is not None:
                    share[:, names.index(str(part.kind))] += probability
        column: NDArray[np.int64] = share.argmax(axis=1)
        return column

    def _logits(self, X: Any) -> FloatArray:
        check_is_fitted(self)
        flat = flat_cases(self, X, reset=False)
        logits = np.empty((len(flat), len(self.classes_)))
        with one_thread(), torch.inference_mode():
            for begin in range(0, len(flat), _CHUNK):
                chosen = slice(begin, begin + _CHUNK)
                logits[chosen] = self.posterior_(_tensor(flat[chosen])).numpy()
        return logits

    def _checked_noise(self) -> tuple[float, float]:
        """The noise range as factors on the recipe's noise.

        Raises:
            ValueError: out of order, or together with a class that is told by its noise.
        """
        if self.noise_range is None:
            return 1.0, 1.0
        low, high = self.noise_range
        require(0.0 < low < high < np.inf, f"noise_range must be 0 < low < high, got {low:g} to {high:g}")
        tells = self.recipe is not None and _tells_noise(self.recipe)
        require(not tells, "noise_range must be None for a recipe with a noise fault: they look the same")
        return low, high


def _tensor(flat: FloatArray) -> torch.Tensor:
    """A tensor of the cases, which are not written to; torch shares memory that may be written alone."""
    return torch.from_numpy(flat if flat.flags.writeable else flat.copy())


def _tells_noise(recipe: Recipe) -> bool:
    return any(kind.changes_noise for kind in recipe.kinds)


def _with_noise(recipe: Recipe, factor: float) -> Recipe:
    sensor = recipe.sensor
    louder = replace(
        sensor,
        current_noise_a=factor * sensor.current_noise_a,
        speed_noise_rad_s=factor * sensor.speed_noise_rad_s,
    )
    return replace(recipe, sensor=louder)


def _severity_loss(outputs: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """Mean negative log-likelihood of the severity of each case under the density of its own kind.

    Args:
        outputs: shape (n, n_kinds * 2).
        targets: index of the kind and position in its range, shape (n, 2).
    """
    densities = outputs.reshape(len(outputs), -1, severity_density.PARAMETERS)
    own = densities[torch.arange(len(outputs)), targets[:, 0].long()]
    return severity_density.negative_log_likelihood(own, targets[:, 1]).mean()
