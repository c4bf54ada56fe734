"""Prints on surfaces: two tones, bands, labels, patches, gradients and marbling, fixed to an object or a thing."""

from dataclasses import dataclass

import numpy as np

_KINDS = ("half", "band", "label", "patch", "gradient", "marble")


@dataclass(frozen=True, eq=False)
class SurfacePrint:
    """Layers of colour over a base colour; later layers cover earlier ones.

    Coordinates are relative: 1 is the distance of the farthest surface from the origin.

    Attributes:
        kind: (k,) names of the layers.
        direction: (k, 3) unit vectors: of a half's, a band's and a gradient's axis, and of a patch's centre.
        low, high: (k,) limits along ``direction``; of a patch, ``high`` is the radius.
        azimuth: (k, 2) angles about z, radians, between which a label lies.
        color: (k, 3) linear RGB.
        frequency: (k, 3) of stripes and marbling, radians per unit.
    """

    kind: tuple[str, ...]
    direction: np.ndarray
    low: np.ndarray
    high: np.ndarray
    azimuth: np.ndarray
    color: np.ndarray
    frequency: np.ndarray

    @classmethod
    def random(cls, rng: np.random.Generator) -> "SurfacePrint":
        """One to five random layers, half of them aligned with the axes, as prints on products mostly are."""
        count = int(rng.integers(1, 6))
        direction = rng.normal(size=(count, 3))
        aligned = rng.random(count) < 0.5
        direction[aligned] = np.eye(3)[rng.choice(3, aligned.sum(), p=(0.15, 0.15, 0.7))]
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        low = rng.uniform(-0.8, 0.7, count)
        start = rng.uniform(-np.pi, np.pi, count)
        return cls(
            tuple(str(name) for name in rng.choice(_KINDS, count)),
            direction,
            low,
            low + rng.uniform(0.1, 0.8, count),
            np.stack([start, start + rng.uniform(0.5, 3.0, count)], axis=1),
            random_colors(rng, count),
            rng.normal(0.0, 12.0, (count, 3)),
        )

    def paint(self, points: np.ndarray, base: np.ndarray) -> np.ndarray:
        """(p, 3) linear colours of surface points.

        Args:
            points: (p, 3) float32 relative coordinates in the frame of the object.
            base: (p, 3) float32 colours below the print.
        """
        painted = base.copy()
        for layer, kind in enumerate(self.kind):
            along = points @ self.direction[layer].astype(np.float32)
            if kind == "gradient":
                painted *= np.clip(1 + 0.6 * along, 0.1, 2.0)[:, None]
            elif kind == "marble":
                waves = np.sin(points @ self.frequency[layer].astype(np.float32) + 2 * np.sin(5 * along))
                painted *= (1 + 0.25 * waves)[:, None]
            else:
                painted[self._covered(layer, kind, points, along)] = self.color[layer]
        return np.clip(painted, 0.005, 1.0)

    def _covered(self, layer: int, kind: str, points: np.ndarray, along: np.ndarray) -> np.ndarray:
        """(p,) bool, which points the layer covers."""
        low, high = self.low[layer], self.high[layer]
        if kind == "half":
            return along > low
        if kind == "patch":
            centre = 0.6 * self.direction[layer]
            return np.linalg.norm(points - centre.astype(np.float32), axis=1) < 0.5 * (high - low) + 0.1
        band = (along > low) & (along < high)
        if kind == "band":
            return band
        start, end = self.azimuth[layer]
        turned = (np.arctan2(points[:, 1], points[:, 0]) - start) % (2 * np.pi)
        letters = np.sin(points @ (3 * self.frequency[layer]).astype(np.float32)) * np.sin(40 * along) > -0.2
        return band & (turned < end - start) & letters


def random_colors(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 3) float32 linear colours: a third white, grey or black, the others of any hue."""
    colors = rng.uniform(0.0, 1.0, (count, 3)) ** 1.5
    plain = rng.random(count) < 0.35
    colors[plain] = rng.choice([0.02, 0.1, 0.4, 0.85], (plain.sum(), 1))
    return colors.astype(np.float32)
