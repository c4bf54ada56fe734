"""The probability that a reported pose is right, from what the image says for and against it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit


@dataclass(frozen=True, eq=False)
class ScoreModel:
    """Logistic regression on named features.

    Attributes:
        names: (f,) of the features, in their order.
        weights: (f,) finite.
        intercept: finite.

    Raises:
        ValueError: there are not as many weights as names, or a number is not finite.
    """

    names: tuple[str, ...]
    weights: np.ndarray
    intercept: float

    def __post_init__(self) -> None:
        if self.weights.shape != (len(self.names),):
            raise ValueError(f"a score model needs {len(self.names)} weights, got shape {self.weights.shape}")
        if not (np.isfinite(self.weights).all() and np.isfinite(self.intercept)):
            raise ValueError("the weights of a score model must be finite")

    def margin(self, features: np.ndarray) -> np.ndarray:
        """(k,) log-odds from (k, f) features."""
        return np.asarray(features @ self.weights + self.intercept)

    def probability(self, features: np.ndarray) -> np.ndarray:
        """(k,) probabilities in (0, 1) from (k, f) features."""
        return np.asarray(expit(self.margin(features)))

    @classmethod
    def fit(
        cls,
        names: Sequence[str],
        features: np.ndarray,
        right: np.ndarray,
        weight: np.ndarray,
        *,
        against: Sequence[str] = (),
        penalty: float = 1e-3,
    ) -> Self:
        """Fit by maximum likelihood with a small penalty on standardised weights.

        Args:
            names: (f,) of the features.
            features: (k, f) of poses.
            right: (k,) bool, whether each pose is right.
            weight: (k,) positive weight of each pose, so that several sources of poses count alike.
            against: names of features that can only lower the score, whatever the data says.
            penalty: weight of the squared norm of the weights of standardised features.

        Raises:
            ValueError: all poses are right, or none is.
        """
        if right.all() or not right.any():
            raise ValueError("a score model needs right and wrong poses")
        mean, deviation = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-9)
        standardised = np.column_stack([(features - mean) / deviation, np.ones(len(features))])
        sign = np.where(right, 1.0, -1.0)
        share = weight / weight.sum()

        def loss(parameters: np.ndarray) -> tuple[float, np.ndarray]:
            margin = sign * (standardised @ parameters)
            free = parameters * (np.arange(len(parameters)) < len(mean))  # the intercept has no penalty
            gradient = -(share * sign * expit(-margin)) @ standardised + 2 * penalty * free
            return float(share @ np.logaddexp(0.0, -margin) + penalty * free @ free), gradient

        bounds = [(None, 0.0 if name in against else None) for name in names] + [(None, None)]
        found = minimize(loss, np.zeros(len(mean) + 1), jac=True, method="L-BFGS-B", bounds=bounds).x
        weights = found[:-1] / deviation
        return cls(tuple(names), weights, float(found[-1] - weights @ mean))

    def as_dict(self) -> dict[str, Any]:
        """What :meth:`from_dict` reads, for JSON."""
        pairs = zip(self.names, self.weights.tolist(), strict=True)
        return {"intercept": round(self.intercept, 4), "weights": {name: round(value, 4) for name, value in pairs}}

    @classmethod
    def from_dict(cls, data: dict[str, Any], names: Sequence[str]) -> Self:
        """A model from JSON.

        Args:
            data: from :meth:`as_dict`.
            names: (f,) of the features that the estimator computes.

        Raises:
            ValueError: the data is of another form, or is for other features.
        """
        try:
            weights, intercept = dict(data["weights"]), float(data["intercept"])
            if set(weights) != set(names):
                raise ValueError(f"it is for the features {', '.join(weights)}, not for {', '.join(names)}")
            return cls(tuple(names), np.array([float(weights[name]) for name in names]), intercept)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"not a score model: {error}") from error
